"""One picture from several methods: which method computes which layer, what is refused, and the sum.

`from_table` reads [render.layers], `choose` decides by what the scene is and what methods cost (`method = "auto"`); both
give an `Assignment` in which every layer has one method at most, and no layer is computed in part unless that is
allowed. `compose` puts the methods' estimates together.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from jaxvol import lights, media
from jaxvol.costs import Costs
from jaxvol.layers import NAMES, SURFACE, VOLUME, Claim, from_items, items
from jaxvol.types import Auxiliary, Estimate, Layers, Scene

_LIFTED = ("converged", "residual", "stopped")  # diagnostics that the command line reports
FIRST = ("emission", "surface_from_light", "volume_from_light")
ALLOW = "allow it with render.allow_partial = true"
THICK = 3.0  # optical thickness, reduced by the mean cosine, from which a lattice is the right tool
WORTH = 0.25  # of the path tracer's time: what other methods may add to it together where it is needed anyway
BASE = "path_tracing"
PEAKED = 0.5  # mean cosine from which virtual lights are dearer than paths (experiments/benchmark_small.toml)

Claims = Callable[[str], tuple[Claim, ...]]  # of a method, by name, for the scene at hand


@dataclass(frozen=True)
class Share:
    """What one method does of a composite."""

    method: str
    claims: tuple[Claim, ...]  # those of its claims that are used
    reasons: tuple[str, ...]  # one per claim, in words

    @property
    def layers(self) -> tuple[str, ...]:
        return tuple(name for claim in self.claims for name in claim.layers)


@dataclass(frozen=True)
class Assignment:
    """Who computes what."""

    shares: tuple[Share, ...]
    missing: tuple[str, ...]  # layers that the scene may contain and nobody computes
    negligible: tuple[str, ...] = ()  # layers left out since they hold next to nothing
    bound: str | None = None  # why, in words


def possible(scene: Scene) -> tuple[str, ...]:
    """The layers that are not exactly zero for want of a light, a surface or a medium."""
    if lights.num_lights(scene) == 0:
        return ()
    absent = set()
    if scene.area_lights is None and scene.environment is None:
        absent.add("emission")
    if scene.mesh is None:
        absent.update(SURFACE, ("volume_from_surface",))
    if scene.medium is None or media.is_empty(scene.medium):
        absent.update(VOLUME, ("surface_from_volume",))
    return tuple(name for name in NAMES if name not in absent)


def from_table(table: dict[str, str], scene: Scene, claims_of: Claims, *, allow_partial: bool = False) -> Assignment:
    """The assignment that [render.layers] asks for; a layer given to "auto" is chosen as `choose` does.

    Raises ValueError for a layer given twice, one that its method does not claim here, part of a sum that the method
    cannot split, and a partial claim that is not allowed.
    """
    wanted: dict[str, str] = {}
    for key, method in table.items():
        for layer in key.split("+"):
            if layer in wanted:
                both = f"{wanted[layer]} and {method}" if wanted[layer] != method else f"{method} twice"
                raise ValueError(f"render.layers: {layer} is given to {both}; a layer has one method")
            wanted[layer] = method
    left = tuple(layer for layer, method in wanted.items() if method == "auto")
    chosen = choose(scene, claims_of, allow_partial=allow_partial, among=left) if left else Assignment((), ())
    shares = []
    for method in dict.fromkeys(method for method in wanted.values() if method != "auto"):
        asked = tuple(layer for layer in NAMES if wanted.get(layer) == method)
        claims = _covering(method, asked, claims_of(method), allow_partial)
        shares.append(Share(method, claims, ("the scene file says so",) * len(claims)))
    return _assignment(scene, (*shares, *chosen.shares))


def _covering(method: str, asked: tuple[str, ...], claims: tuple[Claim, ...], allow_partial: bool) -> tuple[Claim, ...]:
    """Those claims of a method that are asked for."""
    found = []
    for claim in claims:
        common = [layer for layer in claim.layers if layer in asked]
        if not common:
            continue
        if len(common) < len(claim.layers):
            raise ValueError(
                f"render.layers: {method} cannot split {claim.name} here, but only {'+'.join(common)} is asked of it"
            )
        if claim.partial is not None and not allow_partial:
            raise ValueError(f"render.layers: {method} computes {claim.name} only in part here ({claim.partial}); {ALLOW}")
        found.append(claim)
    held = {layer for claim in found for layer in claim.layers}
    for layer in asked:
        if layer not in held:
            have = ", ".join(claim.name for claim in claims) or "nothing"
            raise ValueError(f"render.layers.{layer} = {method!r}: not computed by {method} in this scene; it computes {have}")
    return tuple(found)


def choose(
    scene: Scene,
    claims_of: Claims,
    *,
    allow_partial: bool = False,
    among: tuple[str, ...] | None = None,
    costs: Costs | None = None,
    tolerance: float = 0.0,
) -> Assignment:
    """The first method of `preferences` that claims each layer the scene may contain, with the reason why.

    Complete claims go before partial ones; where a layer has partial ones only, ValueError unless they are allowed. With
    `costs`, methods that are dear beside a path tracer that is needed anyway leave their layers to it (`weighed`).
    Layers that hold less than `tolerance` of the scattered light by `multiple_scattering_bound` are left out.
    """
    order = preferences(scene)
    shares: dict[str, list[tuple[Claim, str]]] = {}
    taken: set[str] = set()
    wanted = tuple(layer for layer in possible(scene) if among is None or layer in among)
    bound = multiple_scattering_bound(scene)
    small = tuple(layer for layer in ("volume_from_volume", "volume_from_multiple") if layer in wanted and bound < tolerance)
    wanted = tuple(layer for layer in wanted if layer not in small)
    for layer in wanted:
        if layer in taken:
            continue
        candidates = [
            (method, claim, reason)
            for method, layers, reason in order
            if layer in layers
            for claim in claims_of(method)
            if layer in claim.layers and set(claim.layers) <= set(wanted) - taken
        ]
        if not candidates:
            continue
        complete = [candidate for candidate in candidates if candidate[1].partial is None]
        method, claim, reason = (complete or candidates)[0]
        if claim.partial is not None and not allow_partial:
            raise ValueError(
                f"method 'auto': no method computes {layer} completely in this scene; {method} does but for this: "
                f"{claim.partial}; {ALLOW}"
            )
        shares.setdefault(method, []).append((claim, reason))
        taken.update(claim.layers)
    found = tuple(Share(m, tuple(c for c, _ in pairs), tuple(r for _, r in pairs)) for m, pairs in shares.items())
    if costs is not None:
        found = weighed(found, claims_of(BASE), costs)
    assigned = _assignment(scene, found)
    if not small:
        return assigned
    missing = tuple(layer for layer in assigned.missing if layer not in small)
    why = f"at most {bound:.1g} of the light that the medium scatters is scattered twice"
    return replace(assigned, missing=missing, negligible=small, bound=why)


def weighed(shares: tuple[Share, ...], base: tuple[Claim, ...], costs: Costs) -> tuple[Share, ...]:
    """The shares without those that are dear beside the path tracer, where that one has a share.

    Its paths carry every layer, so another method only takes noise away. That pays where it adds less time than the
    noise is worth: t < t_path_tracing s / (1 - s) for a layer with the share s of the noise. Nobody knows s beforehand;
    methods may add WORTH of the path tracer's time (s above a fifth), the cheapest layers first. More samples make more
    of them worth it: their time stays the same.
    """
    if all(share.method != BASE for share in shares):
        return shares
    own = {claim.layers: claim for claim in base}
    entries = [(share.method, claim, why) for share in shares for claim, why in zip(share.claims, share.reasons, strict=True)]
    prices = [_price(method, claim, costs) if claim.layers in own else None for method, claim, _ in entries]
    added, dear = 0.0, set()
    for index in sorted((i for i, price in enumerate(prices) if price is not None), key=prices.__getitem__):
        if added + prices[index] <= WORTH * costs.path_tracing:
            added += prices[index]
        else:
            dear.add(index)
    kept: dict[str, list[tuple[Claim, str]]] = {}
    for index, (method, claim, why) in enumerate(entries):
        if index in dear:
            why = f"comes with the paths; {method} would add some {prices[index]:.2g} s to their {costs.path_tracing:.2g}"
            method, claim = BASE, own[claim.layers]
        elif prices[index] is not None:
            why = f"{why}; some {prices[index]:.2g} s beside {costs.path_tracing:.2g} for paths that are traced anyway"
        kept.setdefault(method, []).append((claim, why))
    return tuple(Share(m, tuple(c for c, _ in pairs), tuple(r for _, r in pairs)) for m, pairs in kept.items())


def _price(method: str, claim: Claim, costs: Costs) -> float | None:
    """Seconds of a claim, where there is a rule for them."""
    by_layer = costs.others.get(method, {})
    return sum(by_layer[layer] for layer in claim.layers) if set(claim.layers) <= set(by_layer) else None


def multiple_scattering_bound(scene: Scene) -> float:
    """Most of the power scattered once that a medium can scatter again: albedo (1 - exp(-tau)); 1 where there is no bound.

    tau is along the diagonal of the bounds through the largest density: the longest straight way that light has after a
    scattering. Of the power, not of one picture: it may look away from the light that is scattered once. With surfaces
    light has ways without end, and `volume_from_multiple` holds what they reflect.
    """
    medium = scene.medium
    if medium is None or scene.mesh is not None or not is_straight(scene):
        return 1.0
    low, high = np.asarray(medium.bounds, np.float64)
    every = (medium, *medium.inclusions)
    peak = max(_largest(m.density) * float(np.max(np.asarray(media.sigma_t(m)))) for m in every)
    scattered = [
        np.asarray(m.sigma_s, np.float64) / np.maximum(np.asarray(media.sigma_t(m), np.float64), 1e-300) for m in every
    ]
    return float(np.max(scattered) * -np.expm1(-peak * np.linalg.norm(high - low)))


def _largest(density) -> float:
    return 1.0 if density is None else float(np.max(np.asarray(density)))


def preferences(scene: Scene) -> list[tuple[str, tuple[str, ...], str]]:
    """(method, layers, reason) in the order in which `choose` tries them; the figures behind it are in docs/benchmark.md."""
    medium = scene.medium
    if not is_straight(scene):
        return [("lattice_boltzmann", NAMES, "the medium refracts, and only this method bends rays")]
    order = [("direct", FIRST, "at most one vertex between light and eye: a quadrature without noise")]
    if medium is None or media.is_empty(medium):
        order.append(("instant_multiple_scattering", SURFACE, "surfaces only: virtual lights on them"))
        return [*order, ("path_tracing", NAMES, "no fast method computes it here")]
    tau = thickness(scene)
    reduced = tau * (1.0 - max(float(medium.g), 0.0))
    what = f"optically {'dense' if reduced >= THICK else 'thin'}, {tau:.2g} across"
    order.append(("deep_screen_space", ("volume_from_surface",), "light from surfaces scattered once: splatted surfels"))
    if reduced >= THICK:
        order.append(("lattice_boltzmann", VOLUME, f"{what}: a lattice settles in a few sweeps"))
    if abs(float(medium.g)) >= PEAKED:
        why = f"mean cosine {float(medium.g):.2g}: virtual lights would be seen one by one"
    elif medium.density is not None and scene.mesh is not None:
        why = "a grid among surfaces: virtual lights would march and cast a ray each, and cost more than paths"
    else:
        order.append(("instant_multiple_scattering", NAMES, f"{what}: light paths are shared by all pixels"))
        why = "no fast method computes it completely here"
    return [*order, ("path_tracing", NAMES, why)]


def thickness(scene: Scene) -> float:
    """Mean optical thickness along the diagonal of the medium's bounds, largest of the channels; inclusions apart."""
    medium = scene.medium
    mean = 1.0 if medium.density is None else float(np.mean(np.asarray(medium.density)))
    diagonal = float(np.linalg.norm(np.diff(np.asarray(medium.bounds, np.float64), axis=0)))
    return float(np.max(np.asarray(media.sigma_t(medium)))) * mean * diagonal


def is_straight(scene: Scene) -> bool:
    """Whether no medium has a refractive index other than 1."""
    if scene.medium is None:
        return True
    every = (scene.medium, *scene.medium.inclusions)
    return all(one.ior is None or float(np.max(np.abs(np.asarray(one.ior) - 1.0))) <= 1e-6 for one in every)


def _assignment(scene: Scene, shares: tuple[Share, ...]) -> Assignment:
    held = {layer for share in shares for layer in share.layers}
    return Assignment(shares, tuple(name for name in possible(scene) if name not in held))


def compose(parts: list[tuple[Share, Estimate]]) -> Estimate:
    """The methods' estimates as one: of each the layers that it was asked for; diagnostics by "method.name".

    Layers of methods that know no variance have none. `converged`, `residual`, `stopped`: of the method that has them.
    """
    means, variances, diagnostics = {}, {}, {}
    auxiliary: Auxiliary | None = None
    for share, estimate in parts:
        names = {claim.name for claim in share.claims}
        means |= _picked(estimate.mean, names, share.layers)
        if estimate.variance is not None:
            variances |= _picked(estimate.variance, names, share.layers)
        auxiliary = estimate.auxiliary if auxiliary is None else auxiliary
        diagnostics |= {f"{share.method}.{key}": value for key, value in estimate.diagnostics.items()}
        diagnostics |= {key: estimate.diagnostics[key] for key in _LIFTED if key in estimate.diagnostics}
    variance = from_items(variances) if variances else None
    return Estimate(mean=from_items(means), variance=variance, auxiliary=auxiliary, diagnostics=diagnostics)


def _picked(layers: Layers, names: set[str], wanted: tuple[str, ...]) -> dict[str, object]:
    """By name what was asked for; a sum that was claimed may come in its parts."""
    return {name: image for name, image in items(layers) if name in names or name in wanted}
