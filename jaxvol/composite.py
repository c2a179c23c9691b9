"""One picture from several methods: which method computes which layer, what is refused, and the sum.

`from_table` reads [render.layers], `choose` decides by what the scene is (`method = "auto"`); both give an `Assignment`
in which every layer has one method at most, and no layer is computed in part unless that is allowed. `compose` puts the
methods' estimates together.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jaxvol import lights, media
from jaxvol.layers import NAMES, SURFACE, VOLUME, Claim, from_items, items
from jaxvol.types import Auxiliary, Estimate, Layers, Scene

_LIFTED = ("converged", "residual", "stopped")  # diagnostics that the command line reports
FIRST = ("emission", "surface_from_light", "volume_from_light")
ALLOW = "allow it with render.allow_partial = true"
THICK = 3.0  # optical thickness, reduced by the mean cosine, from which a lattice is the right tool
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


def choose(scene: Scene, claims_of: Claims, *, allow_partial: bool = False, among: tuple[str, ...] | None = None) -> Assignment:
    """The first method of `preferences` that claims each layer the scene may contain, with the reason why.

    Complete claims go before partial ones; where a layer has partial ones only, ValueError unless they are allowed.
    """
    order = preferences(scene)
    shares: dict[str, list[tuple[Claim, str]]] = {}
    taken: set[str] = set()
    wanted = tuple(layer for layer in possible(scene) if among is None or layer in among)
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
    return _assignment(scene, found)


def preferences(scene: Scene) -> list[tuple[str, tuple[str, ...], str]]:
    """(method, layers, reason) in the order in which `choose` tries them; the figures behind it are in docs/benchmark.md."""
    medium = scene.medium
    if medium is not None and _refracts(medium):
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


def _refracts(medium) -> bool:
    every = (medium, *medium.inclusions)
    return any(one.ior is not None and float(np.max(np.abs(np.asarray(one.ior) - 1.0))) > 1e-6 for one in every)


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
