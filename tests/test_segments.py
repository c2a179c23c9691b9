"""Segments of rays in nested media against intervals of exact shapes, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxvol import ray_casting
from jaxvol.segments import is_box, medium_casters, region_at, segments
from jaxvol.types import Medium, Mesh

KINDS = ("embree", "bvh")


def to_mesh(shape):
    return Mesh(
        vertices=jnp.asarray(shape.vertices, jnp.float32),
        faces=jnp.asarray(shape.faces, jnp.int32),
        albedo=jnp.zeros((len(shape.faces), 3), jnp.float32),
    )


def make_medium(*, bounds, shape=None, inclusions=()):
    return Medium(
        bounds=jnp.asarray(bounds, jnp.float32),
        sigma_s=jnp.ones(3),
        sigma_a=jnp.zeros(3),
        g=jnp.zeros(()),
        boundary=None if shape is None else to_mesh(shape),
        inclusions=inclusions,
    )


def of_shape(shape):
    low, high = shape.bounds
    return make_medium(bounds=(low, high), shape=shape)


def convex_interval(shape, origin, direction, *, grown=0.0):
    """Interval of lines inside a convex mesh by its face planes, moved out by `grown`, float64."""
    normal = shape.face_normals
    facing = direction @ normal.T
    t = ((shape.triangles[:, 0] * normal).sum(1) + grown - origin @ normal.T) / np.where(facing == 0, 1e-300, facing)
    low = np.max(np.where(facing < 0, t, -np.inf), 1)
    high = np.min(np.where(facing > 0, t, np.inf), 1)
    return np.maximum(low, 0), high


def lengths_per_region(record, num_regions):
    t, region = np.asarray(record.t, np.float64), np.asarray(record.region)
    piece = np.diff(t, axis=1)
    return np.stack([np.sum(np.where(region == i, piece, 0), 1) for i in range(num_regions)], 1)


def check_form(record):
    t, region = np.asarray(record.t), np.asarray(record.region)
    piece = np.diff(t, axis=1)
    assert np.all(np.isfinite(t)) and np.all(piece >= 0) and region.dtype == np.int32
    assert np.all(region[piece == 0] == -1) or not np.any(region[piece == 0] >= 0)
    assert np.all((region[:, 1:] != region[:, :-1]) | (piece[:, 1:] == 0))  # neighbours are merged
    assert int(record.num_overflows) == 0


def cut(kind):
    """`segments` as it is used with this kind of caster: eager around Embree, under jit otherwise."""
    return segments if kind == "embree" else jax.jit(segments)


@pytest.fixture(scope="module")
def nested():
    """A box of fog with an off-centre ball in it, a small ball in that one, and a box that sticks out of the fog."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.6)
    core = trimesh.creation.icosphere(subdivisions=1, radius=0.25)
    core.apply_translation([0.2, 0.1, 0.0])
    box = trimesh.creation.box(bounds=[[0.3, -0.2, -0.2], [1.5, 0.2, 0.2]])
    shapes = (ball, core, box)
    return make_medium(bounds=[[-1, -1, -1], [1, 1, 1]], inclusions=tuple(of_shape(s) for s in shapes)), shapes


def random_rays(num, *, seed=0, outer=2.5):
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-outer, outer, (num, 3))
    origin[: num // 2] *= 0.3  # half of them start inside
    direction = rng.uniform(-0.8, 0.8, (num, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    t_max = np.where(rng.uniform(size=num) < 0.5, np.inf, rng.uniform(0, 3, num))
    return origin.astype(np.float32), direction.astype(np.float32), t_max.astype(np.float32)


def dense_lengths(medium, shapes, origin, direction, t_max, num=4000):
    """Length in each region by marching: the last that contains the point, at `num` midpoints up to 8."""
    far = np.minimum(t_max, 8.0).astype(np.float64)
    t = (np.arange(num) + 0.5) / num * far[:, None]
    lows, highs = [], []
    cube = trimesh.creation.box(bounds=np.asarray(medium.bounds))
    for shape in (cube, *shapes):
        low, high = convex_interval(shape, origin.astype(np.float64), direction.astype(np.float64))
        lows.append(low), highs.append(high)
    owner = np.full(t.shape, -1)
    for i, (low, high) in enumerate(zip(lows, highs, strict=True)):
        owner = np.where((t >= low[:, None]) & (t <= high[:, None]), i, owner)
    return np.stack([np.mean(owner == i, 1) * far for i in range(len(lows))], 1)


def test_nested_convex_regions(nested):
    medium, shapes = nested
    origin, direction, t_max = random_rays(800)
    record = segments(medium, origin, direction, t_max, casters=medium_casters(medium, kind="embree"))
    check_form(record)
    got = lengths_per_region(record, 4)
    expected = dense_lengths(medium, shapes, origin, direction, t_max)
    # Marching is off by less than a step at each of at most eight ends.
    assert np.max(np.abs(got - expected)) < 8 * 8.0 / 4000
    np.testing.assert_allclose(got.mean(0), expected.mean(0), rtol=2e-3)
    assert np.all(expected.mean(0) > 0.02)
    assert np.max(np.asarray(record.t)[:, -1] - np.minimum(t_max, 100)) <= 0


def test_kinds_give_the_same_segments(nested):
    medium, _ = nested
    origin, direction, t_max = random_rays(500, seed=1)
    host = segments(medium, origin, direction, t_max, casters=medium_casters(medium, kind="embree"))
    for kind in KINDS[1:]:
        jitted = jax.jit(segments)(medium, origin, direction, t_max, casters=medium_casters(medium, kind=kind))
        assert np.array_equal(np.asarray(jitted.region), host.region)
        np.testing.assert_allclose(np.asarray(jitted.t), host.t, atol=3e-6)


def test_the_order_of_two_exact_boxes_along_a_ray():
    inner = trimesh.creation.box(bounds=[[1, 0, 0], [2, 1, 1]])
    hole = trimesh.creation.box(bounds=[[1.25, 0.25, 0.25], [1.5, 0.75, 0.75]])
    medium = make_medium(bounds=[[0, 0, 0], [3, 1, 1]], inclusions=(of_shape(inner), of_shape(hole)))
    casters = medium_casters(medium, kind="embree")
    origin = np.array([[-1, 0.4, 0.5], [-1, 0.1, 0.5], [1.3, 0.4, 0.5], [-1, 2, 0.5], [4, 0.4, 0.5]], np.float32)
    direction = np.tile(np.array([[1, 0, 0]], np.float32), (5, 1))
    record = segments(medium, origin, direction, np.full(5, np.inf, np.float32), casters=casters)
    check_form(record)
    expected = [
        ([1, 2, 2.25, 2.5, 3, 4], [0, 1, 2, 1, 0]),
        ([1, 2, 3, 4], [0, 1, 0]),
        ([0, 0.2, 0.7, 1.7], [2, 1, 0]),
        ([0], []),
        ([0], []),
    ]
    for row, (t, region) in enumerate(expected):
        np.testing.assert_allclose(np.asarray(record.t)[row, : len(t)], t, atol=1e-5)
        np.testing.assert_allclose(np.asarray(record.t)[row, len(t) :], t[-1], atol=1e-5)
        assert np.asarray(record.region)[row, : len(region)].tolist() == region
        assert np.all(np.asarray(record.region)[row, len(region) :] == -1)


def test_vacuum_between_two_bodies_of_one_boundary():
    two = trimesh.util.concatenate(
        [trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]]), trimesh.creation.box(bounds=[[2, 0, 0], [3, 1, 1]])]
    )
    overlapping = trimesh.util.concatenate(
        [trimesh.creation.box(bounds=[[0, 0, 0], [2, 1, 1]]), trimesh.creation.box(bounds=[[1, 0.1, 0.1], [3, 0.9, 0.9]])]
    )
    origin = np.array([[-1, 0.4, 0.3], [0.5, 0.4, 0.3], [1.5, 0.4, 0.3]], np.float32)
    direction = np.tile(np.array([[1, 0, 0]], np.float32), (3, 1))
    t_max = np.array([np.inf, 2.0, np.inf], np.float32)
    cases = (
        (two, [[1, 2, 3, 4], [0, 0.5, 1.5, 2], [0.5, 1.5]], [[0, -1, 0], [0, -1, 0], [0]]),
        (overlapping, [[1, 4], [0, 2], [0, 1.5]], [[0], [0], [0]]),
    )
    for shape, ts, regions in cases:
        medium = of_shape(shape)
        record = segments(medium, origin, direction, t_max, casters=medium_casters(medium, kind="embree"))
        check_form(record)
        for row, (t, region) in enumerate(zip(ts, regions, strict=True)):
            np.testing.assert_allclose(np.asarray(record.t)[row, : len(t)], t, atol=1e-5)
            assert np.asarray(record.region)[row, : len(region)].tolist() == region


def test_a_plain_box_is_a_closed_form_under_jit():
    medium = make_medium(bounds=[[-1, -1, -1], [1, 1, 1]])
    assert is_box(medium)
    origin, direction, t_max = random_rays(1000, seed=2)
    record = jax.jit(segments)(medium, origin, direction, t_max, casters=medium_casters(medium))
    check_form(record)
    assert record.t.shape == (1000, 2) and record.region.shape == (1000, 1)
    low, high = convex_interval(trimesh.creation.box(extents=[2, 2, 2]), origin.astype(float), direction.astype(float))
    high = np.minimum(high, t_max)
    expected = np.where((low < high)[:, None], np.stack([low, high], 1), 0.0)
    np.testing.assert_allclose(np.asarray(record.t), expected, atol=1e-5)
    assert np.array_equal(np.asarray(record.region)[:, 0] == 0, low < high)


def test_rays_that_graze_and_rays_along_faces():
    """Whatever a ray along a face or an edge is told, it stays within the shape and never leaks beyond it."""
    shape = trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]])
    medium = of_shape(shape)
    casters = medium_casters(medium, kind="embree")
    s = np.linspace(-0.5, 1.5, 41)
    planes = np.array([0, 1, 0.5, 1 - 6e-8, 1 + 2e-7, 1e-8, -1e-8])
    along = np.array([[-1, a, b] for a in planes for b in np.concatenate([planes, s])], np.float32)
    direction = np.tile(np.array([[1, 0, 0]], np.float32), (len(along), 1))
    diagonal = np.array([[-1, -1 + a, b] for a in planes for b in s], np.float32)
    origin = np.concatenate([along, diagonal])
    direction = np.concatenate([direction, np.tile(np.array([[0.6, 0.8, 0]], np.float32), (len(diagonal), 1))])
    for t_max in (np.inf, 1.5):
        limit = np.full(len(origin), t_max, np.float32)
        record = segments(medium, origin, direction, limit, casters=casters)
        check_form(record)
        low, high = convex_interval(shape, origin.astype(float), direction.astype(float))
        high = np.maximum(np.minimum(high, t_max), low)
        got = lengths_per_region(record, 1)[:, 0]
        assert np.all(got <= high - low + 1e-5)
        inner = np.all((origin[:, 1:] > 0.01) & (origin[:, 1:] < 0.99), 1) & (direction[:, 1] == 0)
        assert np.count_nonzero(inner) > 15
        np.testing.assert_allclose(got[inner], (high - low)[inner], atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_rays_through_vertices_and_edges_of_a_ball(kind):
    ball = trimesh.creation.icosphere(subdivisions=2)
    medium = of_shape(ball)
    casters = medium_casters(medium, kind=kind)
    rng = np.random.default_rng(3)
    ends = ball.vertices[ball.edges_unique]
    points = np.concatenate([ball.vertices, ends.mean(1), 0.3 * ends[:, 0] + 0.7 * ends[:, 1]]).astype(np.float32)
    target = np.roll(points, 7, axis=0)
    for origin in (points * 3, points * 0.1, rng.uniform(-0.5, 0.5, points.shape).astype(np.float32)):
        direction = target - origin
        direction = np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True), np.float32)
        record = cut(kind)(medium, origin, direction, np.full(len(origin), np.inf, np.float32), casters=casters)
        check_form(record)
        got = lengths_per_region(record, 1)[:, 0]
        bounds = []
        for grown in (-2e-4, 2e-4):  # rays that meet an edge are moved aside
            low, high = convex_interval(ball, origin.astype(float), direction.astype(float), grown=grown)
            bounds.append(np.maximum(high - low, 0))
        assert np.all((got >= bounds[0] - 1e-5) & (got <= bounds[1] + 1e-5))


def test_limits_are_counted():
    slabs = [trimesh.creation.box(bounds=[[i, 0, 0], [i + 0.5, 1, 1]]) for i in range(6)]
    medium = of_shape(trimesh.util.concatenate(slabs))
    casters = medium_casters(medium, kind="embree")
    origin = np.array([[-1, 0.4, 0.3], [-1, 5, 0.3]], np.float32)
    direction = np.tile(np.array([[1, 0, 0]], np.float32), (2, 1))
    t_max = np.full(2, np.inf, np.float32)
    whole = segments(medium, origin, direction, t_max, casters=casters, max_hits=12)
    check_form(whole)
    np.testing.assert_allclose(lengths_per_region(whole, 1)[:, 0], [3, 0], atol=1e-5)
    few_hits = segments(medium, origin, direction, t_max, casters=casters, max_hits=4)
    assert int(few_hits.num_overflows) == 1
    few_pieces = segments(medium, origin, direction, t_max, casters=casters, max_hits=12, max_segments=3)
    assert int(few_pieces.num_overflows) == 1 and few_pieces.region.tolist() == [[0, -1, 0], [-1, -1, -1]]
    np.testing.assert_allclose(few_pieces.t[0], [1, 1.5, 2, 2.5], atol=1e-5)
    with pytest.raises(ValueError, match="casters: 0 given for 1 regions"):
        segments(medium, origin, direction, t_max, casters=())


def test_region_at_finds_the_last_region_that_holds_a_point(nested):
    medium, shapes = nested
    rng = np.random.default_rng(4)
    points = rng.uniform(-1.4, 1.4, (3000, 3)).astype(np.float32)
    points[::3] *= 0.4
    got = np.asarray(region_at(medium, points, casters=medium_casters(medium, kind="embree")))
    expected, margin = np.full(len(points), -1), np.full(len(points), np.inf)
    for i, shape in enumerate((trimesh.creation.box(extents=[2, 2, 2]), *shapes)):
        height = np.max(points @ shape.face_normals.T - (shape.triangles[:, 0] * shape.face_normals).sum(1), 1)
        expected = np.where(height <= 0, i, expected)
        margin = np.minimum(margin, np.abs(height))
    clear = margin > 1e-6
    assert np.array_equal(got[clear], expected[clear])
    assert np.all(np.bincount(expected + 1) > 30)


@pytest.mark.parametrize("kind", KINDS)
def test_all_intersections_of_a_torus(kind):
    """Up to four crossings of a shape that is not convex, inside-out or not; float64 roots of the faceted shape."""
    torus = trimesh.creation.torus(major_radius=1.0, minor_radius=0.4, major_sections=24, minor_sections=12)
    origin, direction, t_max = random_rays(400, seed=5, outer=2.0)
    t_max[:] = np.inf
    for shape in (torus, trimesh.Trimesh(torus.vertices, torus.faces[:, ::-1], process=False)):
        caster = ray_casting.make_caster(to_mesh(shape), kind=kind)
        find = ray_casting.all_intersections
        find = find if kind == "embree" else jax.jit(find, static_argnames="max_hits")
        t, face, overflow = (np.asarray(x) for x in find(caster, origin, direction, t_max, max_hits=4))
        assert overflow == 0 and np.array_equal(np.isfinite(t), face >= 0)
        a, b, c = np.moveaxis(torus.triangles, 1, 0)
        for row in range(len(origin)):
            o, d = origin[row].astype(float), direction[row].astype(float)
            matrix = np.stack([b - a, c - a, -np.broadcast_to(d, a.shape)], -1)
            u, v, root = np.linalg.solve(matrix, (o - a)[..., None])[..., 0].T
            expected = np.sort(root[(u >= 0) & (v >= 0) & (u + v <= 1) & (root > 0)])
            found = t[row][np.isfinite(t[row])]
            assert len(found) == len(expected) and np.allclose(found, expected, atol=1e-5)
        few = find(caster, origin, direction, t_max, max_hits=2)
        assert int(few[2]) == np.count_nonzero(np.isfinite(t[:, 2]))
