"""`jaxvol bake`: light baked onto a scene's surfaces and into probes, as EXR lightmap, GLB and .npz."""

import dataclasses
import io
import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from jaxvol import image, jobs, rendering, tables
from jaxvol.layers import SURFACE
from jaxvol.methods import impulse_response
from jaxvol.methods.impulse_response import baking, gltf, lightmap, probes, receivers
from jaxvol.scene import load_scene


class Target(StrEnum):
    """Where baked light is kept."""

    lightmap = "lightmap"
    vertices = "vertices"
    probes = "probes"


class Occlusion(StrEnum):
    """What happens to scattered light of occluded emitters."""

    march = "march"
    drop = "drop"


class BackScattering(StrEnum):
    """How patches beside and behind receivers are found."""

    area = "area"
    epsilon = "epsilon"
    none = "none"


class Scattering(StrEnum):
    """What of the medium is baked."""

    surface = "surface"
    attenuated = "attenuated"
    single = "single"
    multiple = "multiple"


BACK_SCATTERING = {BackScattering.area: True, BackScattering.epsilon: "epsilon", BackScattering.none: False}


def bake(
    scene: Annotated[Path, typer.Argument(help="Scene file (TOML).", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder for the results; made where missing.")] = Path("out"),
    targets: Annotated[list[Target] | None, typer.Option("--target", help="What to bake; may be repeated.")] = None,
    scattering: Annotated[Scattering, typer.Option(help="What of the medium is baked.")] = Scattering.multiple,
    samples: Annotated[int, typer.Option(help="Surface paths per texel, vertex or probe direction.", min=1)] = 64,
    resolution: Annotated[int, typer.Option(help="Texels along the lightmap's side.")] = 256,
    spacing: Annotated[float | None, typer.Option(help="Distance of probes; default: an eighth of the scene's size.")] = None,
    max_bounces: Annotated[int, typer.Option(help="Surface vertices after the receiver.")] = 6,
    paper: Annotated[bool, typer.Option("--paper", help="All of the paper's modes: those of the options below.")] = False,
    image_source: Annotated[bool, typer.Option(help="Take off light from behind surfaces by image sources.")] = True,
    back_scattering: Annotated[
        BackScattering, typer.Option(help="Patches beside and behind receivers: in area form, by the paper's trick, or not.")
    ] = BackScattering.area,
    epsilon: Annotated[float, typer.Option(help="How far the paper's trick lifts receivers, in the scene's units.")] = 0.125,
    occlusion: Annotated[Occlusion, typer.Option(help="Scattered light of occluded emitters.")] = Occlusion.march,
    contrast: Annotated[
        float | None, typer.Option(help="Of density, above which a segment is marched; 1 = never.", min=0, max=1)
    ] = None,
    bounded: Annotated[
        float | None,
        typer.Option(help="Mean free paths across the medium, below which all is marched; 0 = never. Default: 7.", min=0),
    ] = None,
    legs: Annotated[
        int | None,
        typer.Option(help="Scatter points of a marched segment before the tables. Default: 2 to 16 if bounded, else 1.", min=1),
    ] = None,
    similarity: Annotated[bool, typer.Option(help="Multiple scattering by similarity to an isotropic medium.")] = False,
    g_range: Annotated[float | None, typer.Option(help="Single scattering interpolated between three values of g.")] = None,
    share: Annotated[
        int,
        typer.Option(help="Texels that share one place of reflected and scattered light; 1: none do.", min=1),
    ] = 4,
    harmonics: Annotated[bool, typer.Option(help="SH of incident light in the lightmap's channels.")] = True,
    table_file: Annotated[Path | None, typer.Option("--tables", help="Table file; default: the shipped set.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the scene.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.", min=0)] = 0,
) -> None:
    """Bake SCENE (lightmap by default) into DIR; a bake that was stopped goes on from its finished parts.

    Writes <scene>_lightmap.exr and .glb, <scene>_vertices.glb and .npz, <scene>_probes.npz, and <scene>_bake.json. Exit
    status 1 after Ctrl-C.
    """
    chosen = list(dict.fromkeys(targets or [Target.lightmap]))
    file = load_scene(scene, overrides=list(set_ or []))
    options = {"scattering": scattering.value, "max_bounces": max_bounces, "epsilon": epsilon}
    if paper:
        options |= {"image": False, "back_scattering": "epsilon", "occlusion": "drop"}
        options |= {"contrast": None, "bounded": None, "cached": False}
        options |= {"similarity": True, "g_range": 0.5 if g_range is None else g_range}
    else:
        options |= {"image": image_source, "back_scattering": BACK_SCATTERING[back_scattering], "occlusion": occlusion.value}
        options |= {"similarity": similarity, "g_range": g_range, "legs": legs}
        if contrast is not None:
            options["contrast"] = contrast if contrast < 1 else None
        if bounded is not None:
            options["bounded"] = bounded
    plan = impulse_response.plan(file.scene, None, **options)
    lookups = None if table_file is None else tables.load(table_file).lookups()
    jobs_of = {}
    for target in chosen:
        jobs_of[target] = _receivers(target, file.scene, resolution, spacing)
    notes = list(dict.fromkeys(note for what, *_ in jobs_of.values() for note in surface_notes(what)))
    for note in notes:
        print(f"note: {note}")
    kit = impulse_response.prepare(file.scene, plan, responses_from=lookups)
    config = {
        "config": file.config,
        "plan": repr(plan),
        "samples": samples,
        "seed": seed,
        "resolution": resolution,
        "spacing": spacing,
        "share": share,
        "harmonics": harmonics,
        "tables": None if table_file is None else str(table_file),
        "versions": rendering.versions(),
    }
    folder = out / f"{file.name}_bake.parts"
    try:
        parts = jobs.Parts(folder, config=config)
    except ValueError as error:
        print(f"note: {error}: starting again")
        parts = jobs.Parts(folder, config=config, restart=True)
    total = sum(len(points) for _, points, _ in jobs_of.values())
    start, results = time.perf_counter(), {}
    try:
        with jobs.stoppable() as stop, jobs.progress(f"bake {file.name}", total=total) as advance:
            for target, (_, points, normals) in jobs_of.items():
                results[target] = baking.bake(
                    # A probe stands in the medium: no surface stops the light that comes back to it.
                    dataclasses.replace(kit, image=kit.image and target is not Target.probes),
                    dataclasses.replace(plan, harmonics=harmonics and target is Target.lightmap),
                    points,
                    normals,
                    name=target.value,
                    samples=samples,
                    seed=seed,
                    share=share if target is Target.lightmap else 1,
                    parts=parts,
                    stop=stop,
                    on_progress=advance,
                )
    except baking.Interrupted as stopped:
        print(f"stopped: {stopped}; the same command goes on from there")
        raise typer.Exit(1) from None
    seconds = time.perf_counter() - start
    for target, (what, _, _) in jobs_of.items():
        for path in WRITERS[target](what, results[target], out, file.name, config):
            print(path)
    report = config | {
        "seconds": seconds,
        "receivers": total,
        "skipped": list(plan.skipped),
        "claims": [{"layers": c.name, "partial": c.partial} for c in impulse_response.claims(file.scene)],
        "shares": {target.value: result.shares for target, result in results.items()},
        "notes": [*file.notes, *notes],
    }
    jobs.write_json(out / f"{file.name}_bake.json", report)
    for target, result in results.items():
        for name, meaning in _SHARES.items():
            if result.shares[name] > 0:
                print(f"{target.value}: {result.shares[name]:.1%} of {meaning}")
    parts.clear()
    print(f"{total} receivers, {samples} paths each, {seconds:.1f} s")


_SHARES = {
    "occluded_share": "the light scattered once was dropped because its emitter is occluded",
    "marched_share": "the segments at receivers were marched instead of looked up",
    "beyond_share": "the lookups lay beyond the tables' largest optical thickness, and were continued as an exponential",
}


def _receivers(target, scene, resolution, spacing):
    """What is baked, receivers and normals."""
    if target is Target.lightmap:
        unwrapped = lightmap.unwrap(scene.mesh, resolution=resolution)
        return unwrapped, unwrapped.receiver, unwrapped.normal
    if target is Target.vertices:
        corners = lightmap.vertices(scene.mesh)
        return corners, corners.receiver, corners.normal
    vertices = np.asarray(scene.mesh.vertices, np.float64)
    bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    extent = bounds[1] - bounds[0]
    bounds[1] += np.where(extent > 0, 0, 0.5 * extent.max())  # a flat scene gets probes above it
    low, step, shape = probes.grid(bounds, float(extent.max()) / 8 if spacing is None else spacing)
    facing, _ = probes.directions()
    points = np.repeat(probes.positions(low, step, shape).reshape(-1, 3), len(facing), axis=0)
    normals = np.tile(facing, (int(np.prod(shape)), 1))
    return (low, step, shape), points.astype(np.float32), normals.astype(np.float32)


def surface_notes(what: lightmap.Lightmap | lightmap.Vertices | tuple) -> list[str]:
    """What a user should know of the surfaces that are baked; nothing of probes."""
    if not isinstance(what, lightmap.Lightmap | lightmap.Vertices):
        return []
    dropped = [f"{what.num_dropped} faces without area are left out"] if what.num_dropped else []
    parts = "closed part is" if what.num_inward == 1 else "closed parts are"
    inward = f"{what.num_inward} {parts} wound inward: the insides are baked; flip_normals = true of the shape turns them"
    return [*dropped, *([inward] if what.num_inward else [])]


def _write_lightmap(what: lightmap.Lightmap, baked: baking.Baked, out: Path, name: str, about: dict) -> list[Path]:
    shape = (*what.covered.shape, 3)

    def picture(values: np.ndarray) -> np.ndarray:
        whole = np.zeros(shape, np.float32)
        whole[what.covered] = values
        return lightmap.dilate(whole, what.covered)

    reflected = what.albedo / np.pi
    outgoing = picture(reflected * baking.total(baked))
    images = {"": outgoing, "irradiance": picture(baking.total(baked)), "albedo": picture(what.albedo)}
    images |= {layer: picture(reflected * baked.irradiance[layer]) for layer in SURFACE}
    if baked.harmonics is not None:
        images |= {receivers.harmonic_name(i): picture(baked.harmonics[:, i]) for i in range(baked.harmonics.shape[1])}
    images["variance"] = picture(reflected * reflected * baked.variance)
    channels = {
        f"{layer}.{letter}".lstrip("."): values[..., c] for layer, values in images.items() for c, letter in enumerate("RGB")
    }
    channels["covered"] = what.covered.astype(np.float32)
    exr, glb = out / f"{name}_lightmap.exr", out / f"{name}_lightmap.glb"
    image.write_exr(exr, channels, metadata=about)
    exposure = image.choose_exposure(outgoing)
    jobs.write_bytes(glb, gltf.textured(what, image.tone_map(outgoing, exposure=exposure) / 255))
    return [exr, glb]


def _write_vertices(what: lightmap.Vertices, baked: baking.Baked, out: Path, name: str, about: dict) -> list[Path]:
    outgoing = what.albedo / np.pi * baking.total(baked)
    exposure = image.choose_exposure(outgoing[None])
    colours = image.tone_map(outgoing[None], exposure=exposure)[0] / 255
    glb, arrays = out / f"{name}_vertices.glb", out / f"{name}_vertices.npz"
    jobs.write_bytes(glb, gltf.vertex_colours(what, colours))
    layers = {f"irradiance.{layer}": values for layer, values in baked.irradiance.items()}
    mesh = {"position": what.position, "normal": what.normal, "albedo": what.albedo, "faces": what.faces}
    _write_npz(arrays, mesh | layers | {"outgoing": outgoing, "variance": baked.variance}, about)
    return [glb, arrays]


def _write_probes(what: tuple, baked: baking.Baked, out: Path, name: str, about: dict) -> list[Path]:
    low, step, shape = what
    irradiance = baking.total(baked).reshape(*shape, -1, 3)
    path = out / f"{name}_probes.npz"
    _write_npz(path, {"low": low, "step": step, "radiance": probes.radiance_from_irradiance(irradiance)}, about)
    return [path]


def _write_npz(path: Path, arrays: dict, about: dict) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays, metadata=np.frombuffer(jobs.config_json(about).encode(), np.uint8))
    jobs.write_bytes(path, buffer.getvalue())  # atomic


WRITERS = {Target.lightmap: _write_lightmap, Target.vertices: _write_vertices, Target.probes: _write_probes}
