"""What every method shares: cameras, rays, meshes, media, lights, scenes, layers. Data only.

Dimension letters: `H W` image, `V F` mesh vertices and faces, `P` lights, `X Y Z` voxels, `*batch` anything; colour
is a trailing 3 (linear RGB). Absent things are `None`: the pytree's structure is the specialisation key, so that XLA
never sees what a scene does not have.

Units and conventions: lengths in scene units, sigma in 1/length, radiance W/(m2 sr), intensity W/sr, irradiance W/m2.
Directions are unit vectors along travel. `cos_theta = dot(incoming travel, outgoing travel)`, so that g > 0 scatters
forward. Grids are `[x, y, z]` with values at cell centres; `bounds` are the outer faces.
"""

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int


class Camera(eqx.Module):
    """A pinhole camera. Camera space: x right = cross(forward, up), y up, -z forward."""

    world_from_camera: Float[Array, "4 4"]  # rigid
    fov_y: Float[Array, ""]  # full vertical angle, radians
    height: int = eqx.field(static=True)
    width: int = eqx.field(static=True)


class Rays(eqx.Module):
    """Half-lines or segments; `t` is a length because directions are unit vectors."""

    origin: Float[Array, "*batch 3"]
    direction: Float[Array, "*batch 3"]  # unit
    t_max: Float[Array, "*batch"]  # inf = unbounded


class Hits(eqx.Module):
    """Nearest intersections of rays with a mesh; where `valid` is False the other fields are finite fillers."""

    t: Float[Array, "*batch"]  # inf on a miss
    face: Int[Array, "*batch"]  # -1 on a miss
    position: Float[Array, "*batch 3"]
    normal: Float[Array, "*batch 3"]  # unit geometric normal by the winding rule, NOT turned towards the ray
    valid: Bool[Array, "*batch"]


class Mesh(eqx.Module):
    """Triangles with one material per face. Lambert reflects on both sides, emission leaves the front side only."""

    vertices: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]  # counter-clockwise seen from the front
    albedo: Float[Array, "F 3"]  # Lambertian reflectance, 0..1
    emission: Float[Array, "F 3"] | None = None  # radiance
    specular: Float[Array, "F 3"] | None = None  # energy of the normalised Phong lobe; albedo + specular <= 1
    exponent: Float[Array, "F"] | None = None  # Phong exponent; None exactly when `specular` is


class PhaseTable(eqx.Module):
    """A phase function given by Legendre moments chi_l (chi_0 = 1): p(cos) = sum (2l+1)/(4 pi) chi_l P_l(cos)."""

    moments: Float[Array, "L"]
    cos_theta: Float[Array, "N"]  # nodes of the tabulated function, increasing from -1 to 1
    value: Float[Array, "N"]  # p at the nodes, >= 0, 1/sr; piecewise linear in cos, normalised over the sphere
    cdf: Float[Array, "N"]  # cumulative 2 pi int p dcos, from 0 to 1


class Majorants(eqx.Module):
    """Maximum density of each coarse cell, of the trilinear interpolant and so a true bound.

    A cell covers `block` of the cubes between voxel centres along each axis, from half a voxel below the lower bounds
    on; the last one may stick out.
    """

    density: Float[Array, "Xc Yc Zc"]
    block: int = eqx.field(static=True)


class Medium(eqx.Module):
    """One participating medium: inside `bounds`, and inside `boundary` where given; `inclusions` override it.

    At a point the LAST of (this medium, *inclusions) that contains it wins. sigma = density * sigma_s (or sigma_a).
    """

    bounds: Float[Array, "2 3"]  # outer faces
    sigma_s: Float[Array, "3"]  # scattering per unit length at density 1
    sigma_a: Float[Array, "3"]  # absorption per unit length at density 1
    g: Float[Array, ""]  # mean cosine; the Henyey-Greenstein parameter unless `phase` is given
    density: Float[Array, "X Y Z"] | None = None  # None = homogeneous, density 1
    majorants: Majorants | None = None  # None exactly when `density` is
    phase: PhaseTable | None = None  # None = Henyey-Greenstein
    ior: Float[Array, ""] | Float[Array, "X Y Z"] | None = None  # refractive index; None = 1, rays stay straight
    boundary: Mesh | None = None  # watertight; None = the box
    inclusions: tuple["Medium", ...] = ()  # each with a `boundary`; no inclusions of their own


class PointLights(eqx.Module):
    position: Float[Array, "P 3"]
    intensity: Float[Array, "P 3"]


class SpotLights(eqx.Module):
    """Intensity is full inside `falloff`, zero outside `cutoff`, linear in the angle in between."""

    position: Float[Array, "P 3"]
    direction: Float[Array, "P 3"]  # unit, axis of the cone, along travel
    intensity: Float[Array, "P 3"]  # inside the falloff cone
    cutoff: Float[Array, "P"]  # half-angle, radians
    falloff: Float[Array, "P"]  # half-angle, radians, <= cutoff


class DirectionalLights(eqx.Module):
    direction: Float[Array, "P 3"]  # unit, of travel
    irradiance: Float[Array, "P 3"]  # on a plane facing the light


class AreaLights(eqx.Module):
    """The emissive faces of the scene's mesh and the distribution that samples them, by area times luminance."""

    face: Int[Array, "P"]
    probability: Float[Array, "P"]  # of choosing this face
    cdf: Float[Array, "P"]  # inclusive cumulative sum, ends at 1
    total: Float[Array, ""]  # sum of area times luminance


class EnvironmentLight(eqx.Module):
    """Radiance from infinity on a latitude-longitude map, y up, looked up bilinearly.

    Row r, column c hold the direction (towards the sky) theta = pi (r + .5) / h from +y, phi = 2 pi (c + .5) / w,
    (x, y, z) = (sin theta sin phi, cos theta, -sin theta cos phi) in map space: the middle column looks along +z,
    the map's left edge along -z, columns run clockwise seen from above.
    """

    radiance: Float[Array, "h w 3"]
    map_from_world: Float[Array, "3 3"]  # rotation
    probability: Float[Array, "h w"]  # of choosing this cell; inside it uniform in solid angle
    row_cdf: Float[Array, "h"]  # marginal, inclusive
    column_cdf: Float[Array, "h w"]  # conditional on the row, inclusive


class Scene(eqx.Module):
    """What there is to be lit; the camera is apart. Any field may be None."""

    mesh: Mesh | None = None  # every surface, merged
    medium: Medium | None = None
    point_lights: PointLights | None = None
    spot_lights: SpotLights | None = None
    directional_lights: DirectionalLights | None = None
    area_lights: AreaLights | None = None
    environment: EnvironmentLight | None = None


class Layers(eqx.Module):
    """One image (or array of radiances) per class of light paths, light to eye (see `jaxvol.layers`); None = not estimated.

    `sums` holds what a method estimates but cannot split, under names such as
    "volume_from_light+volume_from_volume+volume_from_multiple" (parts in the order of the fields below).
    """

    emission: Float[Array, "*batch 3"] | None = None
    surface_from_light: Float[Array, "*batch 3"] | None = None
    surface_from_surface: Float[Array, "*batch 3"] | None = None
    surface_from_volume: Float[Array, "*batch 3"] | None = None
    surface_from_multiple: Float[Array, "*batch 3"] | None = None
    volume_from_light: Float[Array, "*batch 3"] | None = None
    volume_from_surface: Float[Array, "*batch 3"] | None = None
    volume_from_volume: Float[Array, "*batch 3"] | None = None
    volume_from_multiple: Float[Array, "*batch 3"] | None = None
    sums: dict[str, Float[Array, "*batch 3"]] = eqx.field(default_factory=dict)


class Auxiliary(eqx.Module):
    """First-hit guides for denoisers and compositing; None = not estimated."""

    depth: Float[Array, "H W"] | None = None  # distance to the first surface, inf where there is none
    transmittance: Float[Array, "H W 3"] | None = None  # of the medium, up to the first surface
    albedo: Float[Array, "H W 3"] | None = None  # of the first surface
    normal: Float[Array, "H W 3"] | None = None  # of the first surface, turned towards the camera


class Estimate(eqx.Module):
    """What a method's `render` returns: the mean of its layers and how far to trust it."""

    mean: Layers
    variance: Layers | None = None  # of the mean, per pixel and channel; None for deterministic methods
    num_samples: Float[Array, ""] | None = None  # per pixel; None for deterministic methods
    auxiliary: Auxiliary | None = None
    diagnostics: dict[str, Array] = eqx.field(default_factory=dict)  # counts, residuals, flags by name
