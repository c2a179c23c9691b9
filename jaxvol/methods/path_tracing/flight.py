"""Free flight and transmittance through the media along a ray: closed form, and tracked through density grids.

A ray's way through the media is a list of spans (`t` [n, K+1] nondecreasing, `region` [n, K]: -1 vacuum, 0 the main
medium, i the i-th inclusion). A single medium in its box is one span, found in closed form.

Spectral one-sample MIS over RGB: the channel that decides a flight is chosen with probability proportional to the
path's throughput, and the flight is weighted by the throughput-weighted mean of all channels' densities, so that the
sum of the throughput never grows (balance heuristic; Wilkie et al. 2014).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxvol import media, phase, sampling, transmittance
from jaxvol.types import Medium

Spans = tuple[Float[Array, "n K+1"], Int[Array, "n K"]]


def regions(medium: Medium) -> tuple[Medium, ...]:
    """The main medium and its inclusions, numbered as in `region`."""
    return (medium, *medium.inclusions)


def box_spans(medium: Medium, origin, direction, t_max) -> Spans:
    """The one span of a medium that only its box bounds; empty spans have equal ends."""
    t0, t1 = media.box_interval(medium.bounds, origin, direction)
    t1 = jnp.minimum(t1, t_max)
    t0 = jnp.minimum(t0, t1)
    return jnp.stack([t0, t1], axis=-1), jnp.zeros((*t0.shape, 1), jnp.int32)


def clip_spans(spans: Spans, t_max) -> Spans:
    """Spans cut at t_max."""
    t, region = spans
    return jnp.minimum(t, t_max[:, None]), region


def span_sigma(medium: Medium, region: Int[Array, "n"]) -> Float[Array, "n 3"]:
    """sigma_t at density 1 of each lane's region; 0 in vacuum."""
    if not medium.inclusions:
        inside = (region >= 0)[:, None]
        return jnp.where(inside, media.sigma_t(medium), 0.0)
    table = jnp.stack([jnp.zeros(3, jnp.float32), *(media.sigma_t(m) for m in regions(medium))])
    return table[region + 1]


def span_sigma_s(medium: Medium, region: Int[Array, "n"]) -> Float[Array, "n 3"]:
    """sigma_s at density 1 of each lane's region; 0 in vacuum."""
    if not medium.inclusions:
        return jnp.where((region >= 0)[:, None], medium.sigma_s, 0.0)
    table = jnp.stack([jnp.zeros(3, jnp.float32), *(m.sigma_s for m in regions(medium))])
    return table[region + 1]


def optical_thickness(medium: Medium, spans: Spans) -> Float[Array, "n 3"]:
    """Of homogeneous media over all spans, RGB."""
    t, region = spans
    total = 0.0
    for k in range(region.shape[1]):
        total = total + (t[:, k + 1] - t[:, k])[:, None] * span_sigma(medium, region[:, k])
    return total


def choose_channel(throughput: Float[Array, "n 3"], u: Float[Array, "n"]) -> tuple[Int[Array, "n"], Float[Array, "n 3"]]:
    """The hero channel of a flight and the probabilities of choosing each, in proportion to the throughput."""
    weight = jnp.maximum(throughput, 0.0)
    total = jnp.sum(weight, axis=-1)
    share = weight / jnp.maximum(total, 1e-30)[:, None]
    hero = (u > share[:, 0]).astype(jnp.int32) + (u > share[:, 0] + share[:, 1]).astype(jnp.int32)
    return hero, share


def pick(values: Float[Array, "n 3"], channel: Int[Array, "n"]) -> Float[Array, "n"]:
    """One channel of each lane."""
    return jnp.where(channel == 0, values[:, 0], jnp.where(channel == 1, values[:, 1], values[:, 2]))


def sample_homogeneous(medium: Medium, spans: Spans, throughput: Float[Array, "n 3"], u_channel, u_flight):
    """A free flight through homogeneous media, in closed form.

    Returns (t, collided, region, weight [n, 3], pdf): the weight multiplies the throughput and holds sigma_s / density
    of a collision, or transmittance / probability of leaving; pdf is the spectral mean density of t, 1/length.
    """
    hero, share = choose_channel(throughput, u_channel)
    target = -jnp.log1p(-u_flight)  # optical thickness of the hero at which the flight ends
    t_bounds, region_of = spans
    zero = jnp.zeros_like(target)
    passed = jnp.zeros((*target.shape, 3), jnp.float32)  # optical thickness per channel up to the event
    hero_passed = zero
    collided = jnp.zeros(target.shape, bool)
    t, region = zero, jnp.full(target.shape, -1, jnp.int32)
    for k in range(region_of.shape[1]):
        sigma = span_sigma(medium, region_of[:, k])
        hero_sigma = pick(sigma, hero)
        length = t_bounds[:, k + 1] - t_bounds[:, k]
        here = ~collided & (target < hero_passed + hero_sigma * length)
        step = jnp.where(here, (target - hero_passed) / jnp.maximum(hero_sigma, 1e-30), length)
        step = jnp.where(collided, 0.0, jnp.minimum(step, length))
        passed = passed + step[:, None] * sigma
        hero_passed = hero_passed + step * hero_sigma
        t = jnp.where(here, t_bounds[:, k] + step, t)
        region = jnp.where(here, region_of[:, k], region)
        collided = collided | here
    # Relative to the hero, whose optical thickness is at most 16.7 here: nothing under- or overflows.
    relative = jnp.exp(pick(passed, hero)[:, None] - passed)
    sigma = span_sigma(medium, region)
    density = jnp.where(collided[:, None], sigma, 1.0) * relative
    mean = jnp.maximum(jnp.sum(share * density, axis=-1), 1e-37)
    value = jnp.where(collided[:, None], span_sigma_s(medium, region), 1.0) * relative
    weight = value / mean[:, None]
    pdf = jnp.where(collided, mean * jnp.exp(-pick(passed, hero)), 0.0)
    return t, collided, region, weight, pdf


def homogeneous_reach(medium: Medium, region: Int[Array, "n"], origin, direction, throughput, u_channel, u_flight):
    """Length of the flight that `sample_homogeneous` chooses if the ray stays in the medium where it starts.

    inf where that is unknown (region -1) or where the ray crosses the box of any medium before.
    """
    hero = choose_channel(throughput, u_channel)[0]
    sigma = pick(span_sigma(medium, region), hero)
    length = jnp.where(sigma > 0, -jnp.log1p(-u_flight) / jnp.maximum(sigma, 1e-30), jnp.inf)
    for one in regions(medium):
        t0, t1 = media.box_interval(one.bounds, origin, direction)
        crossed = (t1 > t0) & (((t0 > 0) & (t0 < length)) | (t1 < length))
        length = jnp.where(crossed, jnp.inf, length)
    return length


def homogeneous_pdf(medium: Medium, spans: Spans, throughput: Float[Array, "n 3"], t: Float[Array, "n"]):
    """Spectral mean density of a collision at t, 1/length; sigma_s * transmittance there [n, 3]; and the region."""
    t_bounds, region_of = spans
    share = choose_channel(throughput, jnp.zeros_like(t))[1]
    passed = jnp.zeros((*t.shape, 3), jnp.float32)
    region = jnp.full(t.shape, -1, jnp.int32)
    for k in range(region_of.shape[1]):
        low, high = t_bounds[:, k], t_bounds[:, k + 1]
        step = jnp.clip(t - low, 0.0, high - low)
        passed = passed + step[:, None] * span_sigma(medium, region_of[:, k])
        region = jnp.where((t >= low) & (t < high), region_of[:, k], region)
    through = jnp.exp(-passed)
    pdf = jnp.sum(share * span_sigma(medium, region) * through, axis=-1)
    return pdf, span_sigma_s(medium, region) * through, region


def tentative(medium: Medium, spans: Spans, origin, direction, t, span, u_flight, u_corner):
    """One tracking step from t: to the next tentative collision, majorant cell border or span end.

    Returns (t, span, region, share [n, 3]): share = sigma_t(x) / majorant rate per channel at a tentative collision, and
    0 when there was none; span = K once the last span is passed.
    """
    t_bounds, region_of = spans
    num_spans = region_of.shape[1]
    if num_spans == 1:
        region, end = region_of[:, 0], t_bounds[:, 1]
    else:
        at = jnp.minimum(span, num_spans - 1)[:, None]
        region = jnp.take_along_axis(region_of, at, axis=1)[:, 0]
        end = jnp.take_along_axis(t_bounds, at + 1, axis=1)[:, 0]
    step = jnp.maximum(end - t, 0.0)
    rate_share = jnp.zeros((*t.shape, 3), jnp.float32)
    for number, one in enumerate(regions(medium)):
        sigma = media.sigma_t(one)
        strongest = jnp.max(sigma)
        if one.density is None:
            flight = sampling.sample_exponential(u_flight, strongest)
            bound = jnp.where(flight < end - t, 1.0, 0.0)
            move = jnp.where(bound > 0, flight, jnp.maximum(end - t, 0.0))
            found = bound
        else:
            move, bound = transmittance.tentative_step(one, origin, direction, t, end, strongest, u_flight)
            found = media.density_stochastic(one, origin + (t + move)[:, None] * direction, u_corner)
        ratio = jnp.where(bound > 0, found / jnp.where(bound > 0, bound * strongest, 1.0), 0.0)
        if medium.inclusions or num_spans > 1:
            mine = region == number
            step = jnp.where(mine, move, step)
            rate_share = jnp.where(mine[:, None], ratio[:, None] * sigma, rate_share)
        else:
            step, rate_share = move, ratio[:, None] * sigma
    moved = t + step
    ended = moved >= end
    span = span + ended.astype(jnp.int32)
    return moved, span, region, jnp.where(ended[:, None], 0.0, jnp.minimum(rate_share, 1.0))


def albedo(medium: Medium, region: Int[Array, "n"]) -> Float[Array, "n 3"]:
    """Single-scattering albedo of each lane's region; 0 in vacuum."""
    if not medium.inclusions:
        return jnp.where((region >= 0)[:, None], media.single_scattering_albedo(medium), 0.0)
    table = jnp.stack([jnp.zeros(3, jnp.float32), *(media.single_scattering_albedo(m) for m in regions(medium))])
    return table[region + 1]


def phase_value(medium: Medium, region: Int[Array, "n"], cos_theta: Float[Array, "n"]) -> Float[Array, "n"]:
    """Phase function of each lane's region, 1/sr."""
    value = phase.evaluate(medium, cos_theta)
    for number, inclusion in enumerate(medium.inclusions, start=1):
        value = jnp.where(region == number, phase.evaluate(inclusion, cos_theta), value)
    return value


def sample_phase(medium: Medium, region: Int[Array, "n"], direction: Float[Array, "n 3"], u1, u2):
    """A direction from the phase function of each lane's region, and its density."""
    out, pdf = phase.sample(medium, direction, u1, u2)
    for number, inclusion in enumerate(medium.inclusions, start=1):
        mine = region == number
        other, other_pdf = phase.sample(inclusion, direction, u1, u2)
        out, pdf = jnp.where(mine[:, None], other, out), jnp.where(mine, other_pdf, pdf)
    return out, pdf


def scattering_at(medium: Medium, region: Int[Array, "n"], position: Float[Array, "n 3"], corner) -> Float[Array, "n 3"]:
    """sigma_s times density at positions, by one stochastic corner each: unbiased."""
    total = jnp.zeros((*region.shape, 3), jnp.float32)
    for number, one in enumerate(regions(medium)):
        value = media.density_stochastic(one, position, corner)[:, None] * one.sigma_s
        total = jnp.where((region == number)[:, None], value, total)
    return total


def mean_medium(medium: Medium) -> Medium:
    """The same media without their grids: sigma times the mean density. Eager; a stand-in where weights need a pdf."""

    def flat(one):
        if one.density is None:
            return one
        mean = jnp.mean(one.density)
        changed = {"density": None, "majorants": None, "sigma_s": one.sigma_s * mean, "sigma_a": one.sigma_a * mean}
        return Medium(**({f: getattr(one, f) for f in Medium.__dataclass_fields__} | changed))

    inclusions = tuple(flat(one) for one in medium.inclusions)
    return Medium(**({f: getattr(flat(medium), f) for f in Medium.__dataclass_fields__} | {"inclusions": inclusions}))


def span_start(spans: Spans) -> Float[Array, "n"]:
    """Where tracking starts."""
    return spans[0][:, 0]
