"""Scenes and small helpers of the experiments on instant multiple scattering (figures of Engelhardt et al. 2010)."""

import csv
import sys
from contextlib import contextmanager
from pathlib import Path

import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

from jaxvol import camera, media  # noqa: E402
from jaxvol.types import Camera, Medium, Mesh, PointLights, Scene  # noqa: E402


def out_folder() -> Path:
    """Where results go."""
    folder = Path("out") / "instant_multiple_scattering"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_csv(path, header, rows):
    """A table with a header line."""
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


@contextmanager
def figure(path, *, rows=1, columns=1, size=(6.4, 4.0)):
    """A matplotlib figure that is saved at the end."""
    fig, axes = plt.subplots(rows, columns, figsize=size, constrained_layout=True)
    yield axes
    fig.savefig(path, dpi=110)
    plt.close(fig)


def pictures(path, images, *, columns, scale, titles):
    """Pictures side by side with one exposure: linear RGB times `scale`, gamma 2.2. A scale per picture may be given."""
    rows = -(-len(images) // columns)
    scales = np.broadcast_to(np.asarray(scale), (len(images),))
    with figure(path, rows=rows, columns=columns, size=(2.6 * columns, 2.8 * rows)) as axes:
        for axis in np.ravel(axes):
            axis.set_axis_off()
        for axis, image, title, s in zip(np.ravel(axes), images, titles, scales, strict=False):
            axis.imshow(np.clip(np.asarray(image) * s, 0, 1) ** (1 / 2.2), interpolation="nearest")
            axis.set_title(title, fontsize=8)


def floats(*values):
    """A float32 array."""
    return jnp.asarray(values, jnp.float32)


def square_camera(size: int) -> Camera:
    """Looks at the unit cube from z = 4."""
    return Camera(
        world_from_camera=camera.look_at([0, 0, 4.0], [0, 0, 0], [0, 1, 0]),
        fov_y=jnp.float32(0.6),
        height=size,
        width=size,
    )


def _lit(medium, mesh=None, position=(1.5, 1.8, 1.2), intensity=1.0):
    lights = PointLights(position=floats(position), intensity=floats([intensity] * 3))
    return Scene(mesh=mesh, medium=medium, point_lights=lights)


def _medium(sigma_t, albedo, g, *, half=1.0, density=None):
    return Medium(
        bounds=floats([-half] * 3, [half] * 3),
        sigma_s=floats(*[sigma_t * albedo] * 3),
        sigma_a=floats(*[sigma_t * (1 - albedo)] * 3),
        g=jnp.float32(g),
        density=None if density is None else jnp.asarray(density),
        majorants=None if density is None else media.majorants(density),
    )


def cube(g: float = 0.0) -> Scene:
    """Homogeneous cube, sigma_t 3, albedo .95, point light outside."""
    return _lit(_medium(3.0, 0.95, g))


def plume_density(n: int, *, time: float = 0.0) -> np.ndarray:
    """A rising, wavering column of smoke on an n^3 grid."""
    x = (np.arange(n) + 0.5) / n * 2 - 1
    grid_x, y, z = np.meshgrid(x, x, x, indexing="ij")
    sway = 0.25 * np.sin(2.5 * y + time) * (y + 1) / 2
    width = 0.18 + 0.16 * (y + 1)
    radius2 = (grid_x - sway) ** 2 + (z - 0.6 * sway) ** 2
    body = np.exp(-radius2 / (2 * width * width))
    waves = 1 + 0.6 * np.sin(7 * y - 2 * time + 4 * grid_x) * np.sin(5 * z + 6 * grid_x)
    return (body * waves * np.clip(1.2 - np.abs(y), 0, 1)).astype(np.float32)


def plume(n: int = 32, *, g: float = 0.5, time: float = 0.0) -> Scene:
    """Heterogeneous plume, sigma_t up to about 8, albedo .95."""
    return _lit(_medium(8.0, 0.95, g, density=plume_density(n, time=time)))


def box(low, high, color):
    """Vertices, faces and albedos of a closed box."""
    low, high = np.array(low, float), np.array(high, float)
    corners = np.array(
        [[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return corners, faces, np.tile(color, (len(faces), 1))


def mesh_of(boxes) -> Mesh:
    """One mesh of several boxes."""
    vertices, faces, colors, start = [], [], [], 0
    for corners, triangles, color in boxes:
        vertices.append(corners)
        faces.append(triangles + start)
        colors.append(color)
        start += len(corners)
    return Mesh(
        vertices=floats(*np.concatenate(vertices)),
        faces=jnp.asarray(np.concatenate(faces), jnp.int32),
        albedo=floats(*np.concatenate(colors)),
    )


def fogged_room() -> Scene:
    """A room that is open to the eye, a block in it, full of fog of g = 0.3, the light inside."""
    walls = [
        box((-1.1, -1.1, -1.1), (1.1, -1, 1), (0.7, 0.7, 0.7)),
        box((-1.1, 1, -1.1), (1.1, 1.1, 1), (0.7, 0.7, 0.7)),
        box((-1.1, -1, -1.1), (-1, 1, 1), (0.6, 0.2, 0.2)),
        box((1, -1, -1.1), (1.1, 1, 1), (0.2, 0.6, 0.2)),
        box((-1, -1, -1.1), (1, 1, -1), (0.6, 0.6, 0.6)),
        box((-0.6, -1, -0.6), (0.0, -0.2, 0.0), (0.4, 0.4, 0.7)),
    ]
    return _lit(_medium(0.7, 6 / 7, 0.3, half=1.02), mesh_of(walls), position=(0.3, 0.4, 0.2))


def fogged_corner() -> Scene:
    """Floor, back wall and a block in fog of g = 0.3, the light among them."""
    mesh = mesh_of(
        [
            box((-1, -1.1, -1), (1, -1, 1), (0.7, 0.7, 0.7)),
            box((-1, -1, -1.1), (1, 1, -1), (0.6, 0.3, 0.3)),
            box((-0.3, -1, -0.4), (0.3, -0.2, 0.2), (0.4, 0.7, 0.4)),
        ]
    )
    return _lit(_medium(0.7, 6 / 7, 0.3, half=1.2), mesh, position=(0.8, 0.9, 0.7))


def infinite() -> Scene:
    """A box so large that its border cannot matter: sigma_t 1, albedo .9, a point light of power 1 at distance 1."""
    return _lit(_medium(1.0, 0.9, 0.0, half=20.0), position=(0.0, 1.0, 0.0), intensity=1 / (4 * np.pi))


SCENES = {
    "cube": cube,
    "cube_g": lambda: cube(0.7),
    "plume": plume,
    "room": fogged_room,
    "corner": fogged_corner,
}
