"""Pictures after the paper's figures 6, 7, 8, 10, 11 and 12, one or all.

    python experiments/lattice_figures.py [--figures 6 7 8 10 11 12] [--size 128] [--resolution 64]

6: a sphere at several scattering coefficients and albedos. 7: bunny and cow, refractive and heterogeneous. 8: single and
multiple scattering. 10: bodies of one index inside bodies of another (inclusions). 11: clear, weakly scattering bodies
before a checkerboard and an environment map. 12: frames of a deforming body. Without the shared meshes a bumpy ball stands in.
"""

import math

import jax.numpy as jnp
import numpy as np
import trimesh
from lattice_common import HERE, arguments, pictures, timed, volume_image, write_csv
from PIL import Image

from jaxvol import camera as cameras
from jaxvol import lights as light_types
from jaxvol.layers import total
from jaxvol.methods import lattice_boltzmann
from jaxvol.types import Camera, DirectionalLights, Medium, Mesh, PointLights, Scene, SpotLights

DATA = HERE.parent.parent / "shared" / "data" / "meshes"


def mesh_of(shape, albedo=0.0):
    """Our mesh from a trimesh one."""
    faces = jnp.asarray(np.asarray(shape.faces, np.int32))
    return Mesh(jnp.asarray(np.asarray(shape.vertices), jnp.float32), faces, jnp.full((len(faces), 3), albedo))


def solid(name):
    """A watertight mesh scaled to a longest side of 1 about the origin."""
    files = {"bunny": "stanford_bunny_16k_closed.ply", "cow": "spot.ply"}
    path = DATA / files.get(name, "")
    if name in files and path.is_file():
        shape = trimesh.load_mesh(path)
    else:
        shape = trimesh.creation.icosphere(subdivisions=5)
        r = 1 + 0.15 * np.sin(5 * shape.vertices[:, :1]) * np.cos(4 * shape.vertices[:, 1:2])
        shape.vertices = shape.vertices * r
    shape.vertices -= shape.bounds.mean(0)
    shape.vertices /= shape.extents.max()
    return shape


def body(shape, sigma_s, sigma_a, *, ior=None, density=None, inclusions=()):
    """A medium inside a mesh."""
    margin = 0.02
    bounds = np.stack([shape.bounds[0] - margin, shape.bounds[1] + margin])
    as_rgb = lambda x: jnp.broadcast_to(jnp.asarray(x, jnp.float32), (3,))  # noqa: E731
    return Medium(
        jnp.asarray(bounds, jnp.float32), as_rgb(sigma_s), as_rgb(sigma_a), jnp.float32(0.0),
        ior=None if ior is None else jnp.float32(ior), boundary=mesh_of(shape), density=density, inclusions=tuple(inclusions),
    )  # fmt: skip


def marble(resolution=64):
    """A procedural density between 0.2 and 1 over the bounds of a body."""
    axes = [np.linspace(-0.5, 0.5, resolution)] * 3
    x, y, z = np.meshgrid(*axes, indexing="ij")
    veins = np.sin(14 * x + 5 * np.sin(9 * y) + 4 * np.sin(7 * z + 2 * x))
    return jnp.asarray(0.2 + 0.8 * (0.5 + 0.5 * veins) ** 2, jnp.float32)


def spot_light(position=(1.4, 0.9, 0.9), power=6.0):
    position = np.array(position)
    axis = -position / np.linalg.norm(position)
    one = lambda x: jnp.asarray([x], jnp.float32)  # noqa: E731
    return SpotLights(one(position), one(axis), one([power] * 3), one(0.5), one(0.45))


def camera(size, origin=(0.0, 0.35, 2.3), fov=0.55):
    pose = cameras.look_at(list(origin), [0.0, 0.0, 0.0], [0, 1, 0])
    return Camera(jnp.asarray(pose), jnp.float32(fov), size, size)


def shot(scene, view, resolution, *, whole=False, layers=None):
    """(picture, wall and CPU seconds, diagnostics): the volume layers, all layers, or the named ones."""
    plan = lattice_boltzmann.plan(scene, view, resolution=resolution, samples_per_pixel=1, rays_per_voxel=2.0)
    with timed() as spent:
        found = lattice_boltzmann.render(scene, view, plan)
    if layers:
        picture = sum(np.asarray(getattr(found.mean, name)) for name in layers)
    else:
        picture = np.asarray(total(found.mean)) if whole else volume_image(found.mean)
    if not np.isfinite(picture).all() or not bool(found.diagnostics["converged"]):
        raise RuntimeError(f"the lattice did not converge: residual {found.diagnostics['residual']}")
    return picture, spent, found.diagnostics


def figure6(size, resolution):
    ball, lamp = trimesh.creation.icosphere(subdivisions=4, radius=0.5), spot_light()
    for sigma in (4.0, 16.0, 48.0):
        for albedo in (0.8, 0.98):
            medium = body(ball, sigma * albedo, sigma * (1 - albedo), ior=1.3)
            yield (
                f"sigma_t {sigma:g}, albedo {albedo:g}",
                shot(Scene(medium=medium, spot_lights=lamp), camera(size), resolution),
            )


def figure7(size, resolution):
    for name, side in (("bunny", 1.0), ("cow", -1.0)):
        medium = body(solid(name), [40.0, 30.0, 20.0], [0.2, 0.5, 1.2], ior=1.3, density=marble())
        yield name, shot(Scene(medium=medium, spot_lights=spot_light((1.4 * side, 0.9, 0.9))), camera(size), resolution)


def figure8(size, resolution):
    medium = body(solid("bunny"), [24.0, 22.0, 18.0], [0.1, 0.2, 0.5], ior=1.2)
    bulb = PointLights(jnp.asarray([[1.4, 0.5, 0.6]], jnp.float32), jnp.full((1, 3), 4.0))
    yield "point light", shot(Scene(medium=medium, point_lights=bulb), camera(size), resolution)
    scene = Scene(medium=medium, spot_lights=spot_light((1.4, 0.5, 0.6), 4.0))
    yield "spot light, single", shot(scene, camera(size), resolution, layers=("volume_from_light",))
    yield "spot light, multiple", shot(scene, camera(size), resolution)


def figure10(size, resolution):
    cow = solid("cow")
    cow.apply_scale(0.55)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    lamp = spot_light((0.3, 1.6, 0.6))
    inside = body(cow, [10.0, 8.0, 6.0], 0.1, ior=1.5)
    yield (
        "cow in a sphere",
        shot(Scene(medium=body(ball, 0.6, 0.02, ior=1.1, inclusions=[inside]), spot_lights=lamp), camera(size), resolution),
    )
    cube = trimesh.creation.box(extents=[1, 1, 1])
    balls = []
    for x, ior in ((-0.22, 1.6), (0.22, 1.3)):
        one = trimesh.creation.icosphere(subdivisions=3, radius=0.18)
        one.apply_translation([x, 0.05, 0.0])
        balls.append(body(one, 0.4, 0.0, ior=ior))
    scene = Scene(medium=body(cube, 1.2, 0.02, ior=1.05, inclusions=balls), spot_lights=lamp)
    yield "two spheres in a cube", shot(scene, camera(size, (0.7, 0.6, 2.5)), resolution)


def checkerboard(side=8, extent=3.0, height=-0.56):
    """A floor of dark and light squares."""
    x = np.linspace(-extent / 2, extent / 2, side + 1)
    vertices = np.array([[a, height, b] for a in x for b in x])
    faces, albedo = [], []
    for i in range(side):
        for j in range(side):
            a, b, c, d = i * (side + 1) + j, i * (side + 1) + j + 1, (i + 1) * (side + 1) + j, (i + 1) * (side + 1) + j + 1
            faces += [[a, b, c], [b, d, c]]
            albedo += [[0.7] * 3 if (i + j) % 2 else [0.08, 0.1, 0.25]] * 2
    return Mesh(jnp.asarray(vertices, jnp.float32), jnp.asarray(faces), jnp.asarray(albedo))


def sky(height=32):
    """A procedural environment: bright above, warm at one side."""
    theta = (np.arange(height)[:, None] + 0.5) / height * math.pi
    phi = (np.arange(2 * height)[None] + 0.5) / height * math.pi
    up = np.cos(theta) + 0 * phi
    warm = np.exp(-((phi - 1.5) ** 2) / 0.3) * np.exp(-((theta - 1.2) ** 2) / 0.2)
    radiance = (
        0.15
        + 0.35 * np.clip(up, 0, 1)[..., None] * np.array([0.5, 0.7, 1.0])
        + 2.0 * warm[..., None] * np.array([1.0, 0.7, 0.4])
    )
    return light_types.environment_light(radiance)


def figure11(size, resolution):
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    sun = DirectionalLights(jnp.asarray([[-0.5, -0.8, -0.33]]), jnp.full((1, 3), 1.5))
    scene = Scene(mesh=checkerboard(), medium=body(ball, [0.1, 0.5, 0.1], [0.2, 0.02, 0.2], ior=1.4), directional_lights=sun)
    yield "green sphere on a checkerboard", shot(scene, camera(size, (0.3, 0.8, 2.4)), resolution, whole=True)
    scene = Scene(medium=body(ball, 0.3, 0.01, ior=1.33), environment=sky())
    yield "sphere before an environment", shot(scene, camera(size), resolution, whole=True)
    cube, rabbit = trimesh.creation.box(extents=[1, 1, 1]), solid("bunny")
    rabbit.apply_scale(0.75)
    medium = body(cube, 0.1, 0.01, ior=1.1, inclusions=[body(rabbit, [8.0, 6.0, 4.0], 0.1, ior=1.5)])
    yield (
        "bunny in a cube",
        shot(Scene(medium=medium, environment=sky()), camera(size, (0.9, 0.6, 2.6)), resolution, whole=True),
    )


def figure12(size, resolution):
    base = solid("cow")
    for frame in range(8):
        bent = base.copy()
        bent.vertices[:, 1] += 0.08 * np.sin(6 * base.vertices[:, 2] + 0.25 * math.pi * frame)
        medium = body(bent, [30.0, 24.0, 14.0], [0.1, 0.4, 1.0], ior=1.2)
        scene = Scene(medium=medium, spot_lights=spot_light((1.2, 1.2, 1.0)))
        yield f"frame {frame}", shot(scene, camera(size, (1.7, 0.5, 1.6)), resolution)


def animation(path, images):
    """The frames as a looping GIF."""
    scale = 0.8 / max(np.percentile(np.stack(images), 98), 1e-12)
    frames = [Image.fromarray(np.uint8(255 * np.clip(i * scale, 0, 1) ** (1 / 2.2))).resize((256, 256)) for i in images]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=120, loop=0)
    print("wrote", path)


FIGURES = {6: figure6, 7: figure7, 8: figure8, 10: figure10, 11: figure11, 12: figure12}


def main():
    chosen = arguments(__doc__, figures=list(FIGURES), size=128, resolution=64)
    for number in chosen.figures:
        images, titles, rows = [], [], []
        for title, (picture, spent, diagnostics) in FIGURES[number](chosen.size, chosen.resolution):
            images.append(picture)
            titles.append(title)
            rows.append({
                "figure": number, "title": title, "cpu_s": spent.cpu, "wall_s": spent.wall,
                "applications": int(np.max(diagnostics["num_applications"])),
                "residual": float(np.max(diagnostics["residual"])),
            })  # fmt: skip
        write_csv(chosen.out / f"figure{number}.csv", rows)
        pictures(chosen.out / f"figure{number}.png", images, titles)
        if number == 12:
            animation(chosen.out / "figure12.gif", images)


if __name__ == "__main__":
    main()
