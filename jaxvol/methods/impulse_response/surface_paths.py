"""Stage 3, surface paths: the next vertex, its density, and what the way to it transports (section 5).

Irradiance E at x gathers reflected radiance albedo E(y) / pi of patches y through the kernel

    K(x, y) = V(x, y) { cos+_x cos+_y e^-tau / d^2  +  response of the area table }         1/length^2

whose second part also knows patches beside and behind x (back-scattering). One vertex is drawn by one of three techniques
and weighted by the density of all three (balance heuristic): a ray, cosine-distributed as fits the first part, a quarter
of them uniform over the hemisphere for scattered light from walls that meet the surface of x; a probe along the normal
through a point at distance r ~ sigma e^{-sigma r} in the plane of x, which fits the 1/d of back-scattering
(specification 8); a point uniform over the area of all faces.

The paper's way to patches behind (5.2), a mode: rays uniform over the sphere start `Faces.epsilon` above x, and what they
hit in or below the plane of x counts as at distance 0. There d^2 times the response of a point source vanishes with d. It is
finite in equations (14) to (16) as printed, where the source's 1/d^2 is the same all along the ray: radiance L in dw puts

    L(w') = sigma_s p(pi) max(0, n_y w') int_0^inf e^{-2 sigma_t t} dt  L dw  =  albedo / 2 p(pi) max(0, n_y w')  L dw

around the normal n_y of its patch, and that is what the mode adds; light scattered more often has no such limit.
"""

from functools import partial
from math import pi

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxvol import harmonics, ray_casting, sampling
from jaxvol.methods.impulse_response import emitters
from jaxvol.methods.impulse_response.lookup import Pick, Responses
from jaxvol.methods.impulse_response.receivers import Receiver, like
from jaxvol.sampling import dot
from jaxvol.types import Mesh

_STREAM = sampling.stream("impulse_response.surface_paths")
_PICK = sampling.stream("impulse_response.lookups")
_LIFT = 2.0**-16  # offset of rays, relative to coordinates
_UNIFORM = 0.25  # share of uniform directions among rays, where light is scattered
_ORDER = 11  # of the lobe that the epsilon trick brings


class Faces(eqx.Module):
    """Uniform sampling of points over all faces."""

    cdf: Float[Array, "F"]
    density: Float[Array, ""]  # 1 / total area
    scale: Float[Array, ""]  # largest coordinate, for offsets of rays
    epsilon: Float[Array, ""] | None = None  # lift of receivers in the paper's mode of back-scattering


class Proposal(eqx.Module):
    """A candidate for the next vertex: the ray that looks for it, or a point of the area technique."""

    technique: Int[Array, "n"]  # 0 cosine ray, 1 probe, 2 area
    origin: Float[Array, "n 3"]
    direction: Float[Array, "n 3"]
    t_max: Float[Array, "n"]  # 0 where no ray is needed
    face: Int[Array, "n"]  # of the area technique
    point: Float[Array, "n 3"]
    side: Float[Array, "n"]  # +1 or -1: the side of the face that radiates, area technique
    pick: Pick  # for the table lookup


class Arrival(eqx.Module):
    """The next vertex and the two rays that decide its density."""

    valid: Bool[Array, "n"]
    face: Int[Array, "n"]
    position: Float[Array, "n 3"]
    normal: Float[Array, "n 3"]  # of the side that radiates
    direction: Float[Array, "n 3"]  # x -> y
    distance: Float[Array, "n"]
    between: tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "n"]]  # ray: is y visible from x
    plumb: tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "n"]]  # ray: does a probe find y
    radius: Float[Array, "n"]  # of y in the plane of x
    behind: Bool[Array, "n"] | None = None  # y lies in or below the plane of x, with `Faces.epsilon`


def sampled_faces(mesh: Mesh, *, epsilon: float | None = None) -> Faces:
    """The table of the area technique; eager. Faces without area are never chosen; ValueError where no face has any."""
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    if not area.sum() > 0:
        raise ValueError("mesh: no face has an area, there is nothing to bake")
    return Faces(
        cdf=jnp.asarray(np.minimum(np.cumsum(area) / area.sum(), 1), jnp.float32),
        density=jnp.float32(1 / area.sum()),
        scale=jnp.float32(np.abs(corners).max()),
        epsilon=None if epsilon is None else jnp.float32(epsilon),
    )


def lifted(position: Float[Array, "*b 3"], normal: Float[Array, "*b 3"], scale: Float[Array, ""]) -> Float[Array, "*b 3"]:
    """The point moved off its surface to the side of its normal, so that rays do not meet that surface."""
    return position + (_LIFT * scale) * normal


def _probe_height(radius, faces):
    """How far above the plane of x probes start: low beside it, so that no wall nearby hides what lies there."""
    return 0.5 * radius + 8 * _LIFT * faces.scale


@partial(jax.jit, static_argnames="shares")
def propose(
    mesh: Mesh,
    faces: Faces,
    position: Float[Array, "n 3"],
    normal: Float[Array, "n 3"],
    item: Int[Array, "n"],
    sample: Int[Array, "n"],
    seed: Int[Array, ""],
    depth: Int[Array, ""],
    probe_sigma: Float[Array, ""],
    *,
    shares: tuple[float, float, float],
) -> Proposal:
    """Choose a technique with probability `shares` and prepare its ray or point."""
    u = sampling.uniforms(seed, _STREAM, item, 2 * depth, sample)
    v = sampling.uniforms(seed, _STREAM, item, 2 * depth + 1, sample)
    technique = (u[0] > shares[0]).astype(jnp.int32) + (u[0] > shares[0] + shares[1]).astype(jnp.int32)
    start = lifted(position, normal, faces.scale)
    ray = sampling.sample_cosine_hemisphere(u[1], u[2], normal)
    if shares[0] < 1:
        uniform = sampling.direction_about(normal, u[1], jnp.sqrt((1 - u[1]) * (1 + u[1])), u[2])
        ray = jnp.where((v[3] < _UNIFORM)[:, None], uniform, ray)
    if faces.epsilon is not None:
        start, ray = position + faces.epsilon * normal, sampling.sample_uniform_sphere(u[1], u[2])
    radius = sampling.sample_exponential(u[1], probe_sigma)
    s, t = sampling.orthonormal_basis(normal)
    sine, cosine = sampling.sin_cos_turn(u[2])
    above = position + radius[:, None] * (cosine[:, None] * s + sine[:, None] * t)
    above = above + _probe_height(radius, faces)[:, None] * normal
    face = sampling.sample_cdf(u[3], faces.cdf)
    a, b, c = (mesh.vertices[mesh.faces[face, i]] for i in range(3))
    w1, w2 = sampling.sample_triangle(v[0], v[1])
    probing = (technique == 1)[:, None]
    return Proposal(
        technique=technique,
        origin=jnp.where(probing, above, start),
        direction=jnp.where(probing, -normal, ray),
        t_max=jnp.where(technique == 2, 0.0, jnp.inf),
        face=face,
        point=a + w1[:, None] * (b - a) + w2[:, None] * (c - a),
        side=jnp.where(v[2] < 0.5, 1.0, -1.0),
        pick=sampling.uniforms(seed, _PICK, item, depth, sample)[:2],
    )


@jax.jit
def arrive(
    mesh: Mesh,
    faces: Faces,
    position: Float[Array, "n 3"],
    normal: Float[Array, "n 3"],
    proposal: Proposal,
    t: Float[Array, "n"],
    face: Int[Array, "n"],
) -> Arrival:
    """The next vertex from the answers of the proposal's rays, and the rays that tell what else could have found it."""
    hits = ray_casting.hits(mesh, proposal.origin, proposal.direction, t, face)
    by_area = proposal.technique == 2
    chosen = jnp.where(by_area, proposal.face, jnp.maximum(face, 0))
    point = jnp.where(by_area[:, None], proposal.point, hits.position)
    geometric = ray_casting.face_normals(mesh)[chosen]
    against = jnp.where(dot(geometric, proposal.direction) > 0, -1.0, 1.0)
    facing = geometric * jnp.where(by_area, proposal.side, against)[:, None]
    behind = None
    if faces.epsilon is not None:
        behind = dot(point - position, normal) <= 8 * _LIFT * faces.scale
        position = position + faces.epsilon * normal
    delta = point - position
    distance = jnp.sqrt(jnp.maximum(dot(delta, delta), 1e-30))
    start, end = lifted(position, normal, faces.scale), lifted(point, facing, faces.scale)
    way = end - start
    length = jnp.sqrt(jnp.maximum(dot(way, way), 1e-30))
    height = dot(delta, normal)
    lateral = delta - height[:, None] * normal
    radius = jnp.sqrt(jnp.maximum(dot(lateral, lateral), 1e-30))
    top = _probe_height(radius, faces)
    room = top - height
    # Nearer than the rays' offset, directions from the point and from the ray disagree: in an edge the pdf would vanish.
    apart = distance > 8 * _LIFT * faces.scale
    return Arrival(
        valid=(by_area | hits.valid) & apart,
        face=chosen,
        position=point,
        normal=facing,
        direction=delta / distance[:, None],
        distance=distance,
        between=(start, way / length[:, None], length * (1 - 1e-5)),
        plumb=(
            position + lateral + top[:, None] * normal,
            -normal,
            jnp.maximum(room - 2 * _LIFT * faces.scale, 0.0),
        ),
        radius=radius,
        behind=behind,
    )


@partial(jax.jit, static_argnames=("shares", "image"))
def transport(
    mesh: Mesh,
    faces: Faces,
    responses: Responses | None,
    receiver: Receiver,
    proposal: Proposal,
    arrival: Arrival,
    visible: Bool[Array, "n"],
    plumb: Bool[Array, "n"],
    tau: Float[Array, "n 3"] | None,
    probe_sigma: Float[Array, ""],
    by_marching: Bool[Array, "n"] | None,
    marched: Float[Array, "n *rows 3"] | None,
    *,
    shares: tuple[float, float, float],
    image: bool,
) -> tuple[Float[Array, "n *rows 3"], Float[Array, "n *rows 3"]]:
    """albedo / pi K / pdf of the step: (what is not scattered on the way, what is).

    Where `by_marching`, `marched` stands for the tables' response; everywhere where `responses` is None.
    """
    normal, technique = receiver.normal, proposal.technique
    visible = visible | (technique == 0)
    cos_x = jnp.maximum(dot(normal, arrival.direction), 0.0)
    cos_y = jnp.maximum(-dot(arrival.normal, arrival.direction), 0.0)
    spread = jnp.where(visible, cos_y / (arrival.distance * arrival.distance), 0.0)
    pdf = cos_x * spread / pi if arrival.behind is None else spread / (4 * pi)
    if shares[0] < 1:
        even = jnp.where(cos_x > 0, spread, 0.0) / (2 * pi)
        pdf = shares[0] * ((1 - _UNIFORM) * pdf + _UNIFORM * even)
    if shares[1] > 0:
        upward = dot(arrival.normal, normal)
        below = dot(arrival.position - arrival.plumb[0], normal) < 0
        reached = ((plumb & below) | (technique == 1)) & (upward > 0)
        ring = sampling.sample_exponential_pdf(arrival.radius, probe_sigma) / (2 * pi * arrival.radius)
        pdf = pdf + shares[1] * jnp.where(reached, ring * upward, 0.0)
    if shares[2] > 0:
        pdf = pdf + shares[2] * 0.5 * faces.density
    weight = surface_reflectance(mesh, arrival.face) / pi
    weight = weight * jnp.where(arrival.valid, 1 / jnp.maximum(pdf, 1e-30), 0.0)[:, None]
    through = 1.0 if tau is None else jnp.exp(-tau)
    plain = receiver.straight(arrival.direction, weight * spread[:, None] * through)
    if responses is None:
        return plain, jnp.zeros_like(plain) if marched is None else like(weight, marched) * marched
    once, more = emitters.patch_arrivals(
        responses, receiver, arrival.direction, arrival.distance, arrival.normal, tau, image=image, pick=proposal.pick
    )
    response = once + more
    seen = visible.reshape(visible.shape + (1,) * (response.ndim - 1))
    response = jnp.where(seen, response, 0.0)
    if arrival.behind is not None:
        beam = spread[:, None] * responses.returned
        response = jnp.where(arrival.behind.reshape(seen.shape), _returned(receiver, arrival, beam), response)
    if marched is not None:
        response = jnp.where(by_marching.reshape(seen.shape), marched, response)
    return plain, like(weight, response) * response


def _returned(receiver, arrival, beam):
    """What a receiver makes of a beam that comes back from the medium around the patch's normal."""
    lobe = jnp.asarray(harmonics.clamped_cosine(_ORDER), jnp.float32)
    value = receiver.zonal(jnp.broadcast_to(lobe, (beam.shape[0], 1, _ORDER)), arrival.normal)
    return like(beam, value) * value


def surface_reflectance(mesh: Mesh, face: Int[Array, "n"]) -> Float[Array, "n 3"]:
    """Reflectance of the next vertices: Lambert's, and a Phong lobe's counted as Lambertian."""
    if mesh.specular is None:
        return mesh.albedo[face]
    return jnp.minimum(mesh.albedo[face] + mesh.specular[face], 1.0)
