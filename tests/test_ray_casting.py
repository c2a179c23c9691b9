"""Casters against each other, against float64 numpy and against exact shapes."""

import gc
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxvol import ray_casting
from jaxvol.ray_casting import bvh
from jaxvol.types import Mesh

KINDS = ("embree", "bvh", "brute")


def to_mesh(vertices, faces):
    return Mesh(
        vertices=jnp.asarray(vertices, jnp.float32),
        faces=jnp.asarray(faces, jnp.int32),
        albedo=jnp.ones((len(faces), 3), jnp.float32),
    )


def random_triangles(seed, num):
    """Triangle soup: ordinary ones, slivers, points and duplicates."""
    rng = np.random.default_rng(seed)
    triangles = rng.uniform(-1, 1, (num, 3, 3))
    triangles[: num // 4, 1:] = triangles[: num // 4, :1] + 0.3 * rng.normal(size=(num // 4, 2, 3))
    sliver = slice(num // 4, num // 3)
    triangles[sliver, 2] = triangles[sliver, 1] + 1e-4 * rng.normal(size=triangles[sliver, 2].shape)
    triangles[-3:] = triangles[0]
    triangles[-4, 1] = triangles[-4, 2]
    return to_mesh(triangles.reshape(-1, 3), np.arange(3 * num).reshape(-1, 3))


def random_rays(seed, num, *, radius=2.0):
    """Rays between random points, one third of them parallel to an axis."""
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-radius, radius, (num, 3))
    direction = rng.uniform(-1, 1, (num, 3)) - origin
    direction[::3] = np.eye(3)[rng.integers(0, 3, len(direction[::3]))] * rng.choice([-1, 1], (len(direction[::3]), 1))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return origin.astype(np.float32), direction.astype(np.float32)


def nearest_hit_float64(mesh, origin, direction):
    """(t, face, margin) by solving for barycentric coordinates; margin = how far they are from changing the answer."""
    a, b, c = np.moveaxis(np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)], 1, 0)
    best, face, margin = np.full(len(origin), np.inf), np.full(len(origin), -1), np.full(len(origin), np.inf)
    for i in range(len(a)):
        matrix = np.stack([np.broadcast_to(b[i] - a[i], origin.shape), np.broadcast_to(c[i] - a[i], origin.shape),
                           -direction.astype(np.float64)], -1)  # fmt: skip
        regular = np.abs(np.linalg.det(matrix)) > 1e-12
        u, v, t = np.linalg.solve(np.where(regular[:, None, None], matrix, np.eye(3)), (origin - a[i])[..., None])[..., 0].T
        slack = np.where(regular, np.minimum(np.minimum(u, v), 1 - u - v), -np.inf)
        margin = np.where(t > 0, np.minimum(margin, np.abs(slack)), margin)
        closer = (slack >= 0) & (t > 0) & (t < best)
        best, face = np.where(closer, t, best), np.where(closer, i, face)
    return best, face, margin


def box_mesh(low, high):
    box = trimesh.creation.box(bounds=[low, high])
    return to_mesh(box.vertices, box.faces)


@pytest.mark.parametrize("kind", KINDS)
def test_nearest_hits_match_float64(kind):
    mesh = random_triangles(0, 120)
    origin, direction = random_rays(1, 3000)
    t, face, margin = nearest_hit_float64(mesh, origin, direction)
    got_t, got_face = ray_casting.intersect(ray_casting.make_caster(mesh, kind=kind), origin, direction, np.inf)
    got_t, got_face = np.asarray(got_t), np.asarray(got_face)
    clear = margin > 1e-4  # rays that pass an edge or a sliver this close may go either way
    assert np.count_nonzero(clear) > 2000 and np.count_nonzero(clear & (face >= 0)) > 1000
    assert np.array_equal(got_face[clear] >= 0, face[clear] >= 0)
    hit = clear & (face >= 0)
    np.testing.assert_allclose(got_t[hit], t[hit], rtol=2e-5, atol=2e-5)
    duplicates = {0, 117, 118, 119}
    same = (got_face == face) | np.array([{g, f} <= duplicates for g, f in zip(got_face, face, strict=True)])
    assert np.all(same[hit])
    assert np.all(np.isinf(got_t[clear & (face < 0)]))


@pytest.mark.parametrize("kind", KINDS)
def test_t_max_bounds_both_queries(kind):
    mesh = random_triangles(2, 60)
    caster = ray_casting.make_caster(mesh, kind=kind)
    origin, direction = random_rays(3, 1000)
    t, face = (np.asarray(x) for x in ray_casting.intersect(caster, origin, direction, np.inf))
    for factor, expected in ((0.999, False), (1.001, True)):
        t_max = np.where(face >= 0, factor * t, 0.3).astype(np.float32)
        near_t, near_face = (np.asarray(x) for x in ray_casting.intersect(caster, origin, direction, t_max))
        blocked = np.asarray(ray_casting.occluded(caster, origin, direction, t_max))
        assert np.array_equal(near_face >= 0, (face >= 0) & expected)
        assert np.array_equal(blocked, (face >= 0) & expected)
        assert np.all(np.isinf(near_t[near_face < 0]))
    assert np.array_equal(np.asarray(ray_casting.occluded(caster, origin, direction, np.inf)), face >= 0)
    assert 100 < np.count_nonzero(face >= 0) < 900


@pytest.mark.parametrize("kind", KINDS)
def test_rays_at_edges_and_vertices_of_a_closed_mesh_do_not_leak(kind):
    sphere = trimesh.creation.icosphere(subdivisions=2)
    rng = np.random.default_rng(4)
    for offset in ((0.0, 0.0, 0.0), (3.0, -5.0, 2.0)):
        vertices = np.asarray(sphere.vertices + offset, np.float32)
        caster = ray_casting.make_caster(to_mesh(vertices, sphere.faces), kind=kind)
        rounded = trimesh.Trimesh(vertices.astype(np.float64), sphere.faces, process=False)
        edges = vertices[sphere.edges_unique]
        weight = rng.uniform(size=(20, len(edges), 1)).astype(np.float32)
        targets = np.concatenate([vertices, (edges[:, 0] + weight * (edges[:, 1] - edges[:, 0])).reshape(-1, 3)])
        inside = rng.uniform(-0.5, 0.5, targets.shape)
        for start in (inside, 4 * (targets - offset), np.roll(targets - offset, 5, axis=0) * 3):
            origin = np.asarray(offset + start, np.float32)
            direction = targets - origin
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            t, _ = (np.asarray(x) for x in ray_casting.intersect(caster, origin, direction, np.inf))
            # Heights of ray points above the planes of all faces, float64: the surface is where the largest is 0.
            height = np.sum((origin - rounded.triangles[:, 0, None]) * rounded.face_normals[:, None], -1)
            facing = rounded.face_normals @ direction.T
            crossing = -height / np.where(facing == 0, 1, facing)
            entry = np.max(np.where(facing < 0, crossing, -np.inf), 0)
            leave = np.min(np.where(facing > 0, crossing, np.inf), 0)
            deep = (leave - entry > 0.01) & (leave > 0)
            middle = 0.5 * (entry + leave)
            assert np.array_equal((t < middle)[deep], (entry > 0)[deep])
            # Embree takes faces a little beyond their edges (up to 74 roundings here), ours by one rounding.
            roundings = (128 if kind == "embree" else 8) * np.finfo(np.float32).eps * np.max(np.abs(origin))
            assert np.max(np.abs(np.max(height + np.where(deep, t, 0) * facing, 0))[deep]) < roundings
            assert np.count_nonzero(deep) > 1000
            assert np.all(np.asarray(ray_casting.occluded(caster, origin, direction, np.inf))[deep])


@pytest.mark.parametrize("kind", KINDS)
def test_axis_parallel_rays_meet_a_box_on_its_face_diagonals(kind):
    caster = ray_casting.make_caster(box_mesh((0, 0, 0), (1, 1, 1)), kind=kind)
    s = np.linspace(0.05, 0.95, 19)
    origin = np.concatenate([np.stack([s, s, 0 * s + 3], 1), np.stack([s, 1 - s, 0 * s + 3], 1)]).astype(np.float32)
    t, face = ray_casting.intersect(caster, origin, np.array([0, 0, -1], np.float32), np.float32(np.inf))
    np.testing.assert_allclose(np.asarray(t), 2.0, rtol=1e-6)
    assert np.all(np.asarray(face) >= 0)


@pytest.mark.parametrize("kind", KINDS)
def test_odd_batches_and_directions_of_any_length(kind):
    caster = ray_casting.make_caster(box_mesh((-1, -1, -1), (1, 1, 1)), kind=kind)
    origin = np.zeros((2, 3, 3), np.float32)
    t, face = ray_casting.intersect(caster, origin, np.array([0.0, 0.0, 4.0], np.float32), np.inf)
    assert t.shape == face.shape == (2, 3)
    np.testing.assert_allclose(np.asarray(t), 0.25, rtol=1e-6)
    t, face = ray_casting.intersect(caster, origin[:0], origin[:0], np.inf)
    assert t.shape == face.shape == (0, 3)
    assert ray_casting.occluded(caster, origin[:0], origin[:0], np.inf).shape == (0, 3)
    nan = np.full((2, 3), np.nan, np.float32)
    assert np.all(np.asarray(ray_casting.intersect(caster, nan, np.ones_like(nan), np.inf)[1]) == -1)
    assert np.asarray(ray_casting.occluded(caster, origin[0, 0], np.array([1.0, 0, 0], np.float32), np.inf)).shape == ()


def test_nothing_to_hit():
    empty = to_mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    for mesh in (None, empty):
        caster = ray_casting.make_caster(mesh)
        assert caster is None
        t, face = ray_casting.intersect(caster, np.zeros((4, 3)), np.ones((4, 3)), 1.0)
        assert np.all(np.isinf(np.asarray(t))) and np.all(np.asarray(face) == -1)
        assert not np.any(np.asarray(ray_casting.occluded(caster, np.zeros((4, 3)), np.ones((4, 3)), 1.0)))
    assert not np.any(np.asarray(ray_casting.hits(None, jnp.zeros((4, 3)), jnp.ones((4, 3)), t, face).valid))


def test_unknown_kind_and_building_under_jit_are_refused():
    mesh = box_mesh((0, 0, 0), (1, 1, 1))
    with pytest.raises(ValueError, match="kind: unknown caster 'fast'"):
        ray_casting.make_caster(mesh, kind="fast")
    with pytest.raises(ValueError, match="under jit"):
        jax.jit(lambda m: ray_casting.make_caster(m, kind="brute"))(mesh)


@pytest.mark.parametrize("threads", (1, 3))
def test_threads_do_not_change_the_answer(threads):
    mesh = random_triangles(5, 80)
    origin, direction = random_rays(6, 20_001)
    reference = ray_casting.intersect(ray_casting.make_caster(mesh, kind="embree", num_threads=1), origin, direction, np.inf)
    caster = ray_casting.make_caster(mesh, kind="embree", num_threads=threads)
    kept = origin.copy()
    t, face = ray_casting.intersect(caster, origin, direction, np.inf)
    assert np.array_equal(t, reference[0]) and np.array_equal(face, reference[1])
    assert np.array_equal(ray_casting.occluded(caster, origin, direction, np.inf), face >= 0)
    assert np.array_equal(origin, kept)
    t_max = np.full(len(origin), 1.5, np.float32)
    ray_casting.intersect(caster, origin, direction, t_max)
    assert np.all(t_max == 1.5)  # the caller's buffer is not the scratch


def test_caster_for_lives_as_long_as_its_mesh():
    mesh = box_mesh((0, 0, 0), (1, 1, 1))
    twin = box_mesh((0, 0, 0), (1, 1, 1))
    caster = ray_casting.caster_for(mesh)
    assert ray_casting.caster_for(mesh) is caster
    assert ray_casting.caster_for(twin) is not caster
    before = len(ray_casting._casters)
    del mesh
    gc.collect()
    assert len(ray_casting._casters) == before - 1
    assert ray_casting.caster_for(None) is None


@pytest.mark.parametrize("kind", [k for k in KINDS if k != "embree"])
def test_t_is_differentiable_under_jit(kind):
    mesh = random_triangles(7, 40)
    caster = ray_casting.make_caster(mesh, kind=kind)
    origin, direction = random_rays(8, 64)
    _, face = ray_casting.intersect(caster, origin, direction, np.inf)
    hit = np.asarray(face) >= 0

    @jax.jit
    def total(shift):
        t, _ = ray_casting.intersect(caster, origin + shift * direction, direction, np.inf)
        return jnp.sum(jnp.where(hit, t, 0.0))

    np.testing.assert_allclose(jax.grad(total)(1e-4), -np.count_nonzero(hit), rtol=1e-4)
    towards = jax.grad(lambda o: jnp.sum(jnp.where(hit, ray_casting.intersect(caster, o, direction, np.inf)[0], 0.0)))(origin)
    normal = np.asarray(ray_casting.face_normals(mesh))[np.asarray(face)]
    expected = np.where(hit[:, None], -normal / np.sum(normal * direction, -1, keepdims=True), 0.0)
    np.testing.assert_allclose(np.asarray(towards), expected, rtol=1e-3, atol=1e-3)


def test_hits_lie_on_their_faces_even_from_far_away():
    mesh = random_triangles(9, 60)
    origin, direction = random_rays(10, 2000, radius=300.0)
    t, face = ray_casting.intersect(ray_casting.make_caster(mesh), origin, direction, np.inf)
    record = jax.jit(ray_casting.hits)(mesh, origin, direction, t, face)
    valid = np.asarray(record.valid)
    assert 100 < np.count_nonzero(valid) and np.array_equal(valid, face >= 0)
    corner = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)[face]][:, 0]
    normal = np.asarray(record.normal, np.float64)
    height = np.sum(normal * (np.asarray(record.position, np.float64) - corner), -1)
    assert np.max(np.abs(height[valid])) < 5e-7
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, rtol=1e-5)
    assert np.all(np.isfinite(np.asarray(record.position))) and np.all(np.isinf(np.asarray(record.t)[~valid]))


def test_normals_follow_the_winding_rule():
    mesh = to_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]], [[0, 1, 2], [0, 2, 1], [0, 3, 1]])
    np.testing.assert_allclose(np.asarray(ray_casting.face_normals(mesh)), [[0, 0, 1], [0, 0, -1], [0, 0, 1]])


@pytest.mark.parametrize("size", (0.05, 1.0, 100.0))
def test_offset_origins_do_not_hit_their_own_surface(size):
    mesh = box_mesh((-size, -size, -size), (size, size, size))
    caster = ray_casting.make_caster(mesh)
    origin, direction = random_rays(11, 4000, radius=0.9 * size)
    origin *= 0.9 / 2
    t, face = ray_casting.intersect(caster, origin, direction, np.inf)
    record = ray_casting.hits(mesh, origin, direction, t, face)
    inward = -np.asarray(record.normal)
    rng = np.random.default_rng(12)
    leaving = rng.normal(size=inward.shape)
    leaving /= np.linalg.norm(leaving, axis=1, keepdims=True)
    cosine = np.sum(leaving * inward, -1, keepdims=True)
    leaving = np.where(cosine < 0, leaving - 2 * cosine * inward, leaving).astype(np.float32)
    scale = ray_casting.scene_scale(mesh)
    inside = ray_casting.offset_origin(record.position, record.normal, leaving, scale=scale)
    t2, face2 = ray_casting.intersect(caster, inside, leaving, np.inf)
    assert np.all(face2 >= 0)
    normal = np.asarray(ray_casting.face_normals(mesh))
    assert np.all(np.sum(normal[face] * normal[face2], -1) < 0.5)  # another side of the box
    outside = ray_casting.offset_origin(record.position, record.normal, -leaving, scale=scale)
    assert not np.any(ray_casting.occluded(caster, outside, -leaving, np.inf))


@pytest.mark.parametrize("kind", [k for k in KINDS if k != "embree"])
def test_casters_agree_on_the_bunny(kind, shared_data):
    bunny = trimesh.load(shared_data / "meshes/stanford_bunny_16k_closed.ply", process=False)
    mesh = to_mesh(bunny.vertices, bunny.faces)
    rng = np.random.default_rng(13)
    origin = np.asarray(bunny.bounds.mean(0) + rng.normal(size=(512, 3)) * 0.2, np.float32)
    target = np.asarray(bunny.triangles_center[rng.integers(0, len(bunny.faces), 512)] + 0.01 * rng.normal(size=(512, 3)))
    direction = np.asarray((target - origin) / np.linalg.norm(target - origin, axis=1, keepdims=True), np.float32)
    t, face = ray_casting.intersect(ray_casting.make_caster(mesh, kind="embree"), origin, direction, np.inf)
    other = ray_casting.make_caster(mesh, kind=kind)
    other_t, other_face = ray_casting.intersect(other, origin, direction, np.inf)
    assert np.count_nonzero(np.asarray(other_face) != face) <= 1 and np.count_nonzero(face >= 0) > 250
    hit = (face >= 0) & (np.asarray(other_face) >= 0)
    np.testing.assert_allclose(np.asarray(other_t)[hit], t[hit], atol=1e-6)
    t_max = np.where(np.isfinite(t), t * rng.choice([0.99, 1.01], 512), 1.0).astype(np.float32)
    blocked = ray_casting.occluded(ray_casting.make_caster(mesh, kind="embree"), origin, direction, t_max)
    assert np.count_nonzero(np.asarray(ray_casting.occluded(other, origin, direction, t_max)) != blocked) <= 1


@pytest.mark.parametrize("num", (1, 2, 3, 5, 17))
def test_the_tree_holds_every_face_once_inside_its_boxes(num):
    triangles = np.random.default_rng(num).normal(size=(num, 3, 3)).astype(np.float32)
    nodes, leaf_face = bvh.build(triangles)
    assert sorted(leaf_face[leaf_face >= 0]) == list(range(num)) and leaf_face.shape[1] <= 2
    assert len(nodes) == 2 * len(leaf_face)
    for leaf, faces in enumerate(leaf_face):
        node = leaf + len(leaf_face)
        while node >= 1:
            corners = triangles[faces[faces >= 0]]
            assert np.all(corners >= nodes[node, 0:3]) and np.all(corners <= nodes[node, 3:6])
            node //= 2


def sphere_rays(side):
    """Coherent camera rays that see a ball of 16 k faces, as numpy arrays."""
    x, y = np.meshgrid(*[(np.arange(side) + 0.5) / side * 2 - 1] * 2)
    direction = np.stack([0.5 * x, -0.5 * y, -np.ones_like(x)], -1).reshape(-1, 3)
    direction = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    return np.tile(np.array([[0, 0, 2.2]], np.float32), (len(direction), 1)), direction


@pytest.mark.slow
def test_speed_of_embree_and_of_building_a_tree():
    """At least 3 M coherent camera rays per CPU second against 16 k to 20 k faces; a BVH of 80 k faces in 2 s."""
    mesh = to_mesh(trimesh.creation.icosphere(subdivisions=5).vertices, trimesh.creation.icosphere(subdivisions=5).faces)
    caster = ray_casting.make_caster(mesh, kind="embree")
    origin, direction = sphere_rays(1024)
    seconds = []
    for _ in range(5):
        start = time.process_time()
        t, _ = ray_casting.intersect(caster, origin, direction, np.inf)
        seconds.append(time.process_time() - start)
    assert 0.3 < np.isfinite(t).mean() < 0.9
    print(f"embree: {len(origin) / min(seconds) / 1e6:.1f} M rays per CPU second")
    assert len(origin) / min(seconds) > 3e6
    triangles = np.asarray(trimesh.creation.icosphere(subdivisions=6).triangles, np.float32)
    start = time.process_time()
    bvh.build(triangles)
    seconds = time.process_time() - start
    print(f"BVH of {len(triangles)} faces: {seconds:.2f} CPU seconds")
    assert len(triangles) > 80_000 and seconds < 2.0
