"""`jaxvol render`: a scene file to an EXR with all layers, a PNG and a JSON report."""

import math
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import jaxvol
from jaxvol import image, jobs, picture_sheets, rendering
from jaxvol.layers import NAMES, items, total
from jaxvol.scene import SceneFile, load_scene


def render(
    scene: Annotated[Path, typer.Argument(help="Scene file (TOML).", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder for the picture; made where missing.")] = Path("out"),
    method: Annotated[
        str | None, typer.Option(help="Method, or auto: one a layer, by what the scene is. Default: the file's.")
    ] = None,
    beside: Annotated[
        str | None, typer.Option(metavar="METHOD", help="Render with this method too, and show both side by side.")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key, as in medium.anisotropy=0.3.")
    ] = None,
    samples: Annotated[int | None, typer.Option(help="Samples per pixel, for methods that sample.")] = None,
    until_error: Annotated[
        float | None, typer.Option(help="Go on until the mean standard error of 8 x 8 blocks over the mean is this small.")
    ] = None,
    time_: Annotated[float | None, typer.Option("--time", help="Go on for about this many seconds.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the random numbers.")] = None,
    explain: Annotated[bool, typer.Option("--explain", help="Print what the scene lacks and so what is skipped.")] = False,
) -> None:
    """Render SCENE and write DIR/<scene>.exr (all layers), .png (tone mapped) and .json (times, claims, settings).

    With --beside also DIR/<scene>.<METHOD>.exr and .png, and both pictures in DIR/<scene>.beside.png.
    """
    overrides = list(set_ or [])
    for key, value in (("method", method), ("samples", samples), ("seed", seed)):
        if value is not None:
            overrides.append(f"render.{key}={value}")
    file = load_scene(scene, overrides=overrides)
    _prepare(out)
    for note in file.notes:
        _say(f"note: {note}")
    if explain:
        for line in rendering.lacks(file.scene):
            print(line)

    name = "the layers' methods" if file.render.layers and method is None else file.render.method
    goal = {"seconds": time_, "until_error": until_error}
    with jobs.stoppable() as stop, jobs.progress(f"{file.name}, {name}", total=100) as advance:
        done = 0.0

        def on_progress(share: float, note: str = "") -> None:
            nonlocal done
            advance(100 * max(min(share, 1.0) - done, 0.0), note=note)
            done = max(done, min(share, 1.0))

        job = rendering.Job(out / f"{file.name}.parts", stop, {key: value for key, value in goal.items() if value is not None})
        result = rendering.render_scene(file, method=method, on_progress=on_progress, job=job)
        stopped = bool(result.estimate.diagnostics.get("stopped", False))
        if not stopped:
            advance(100 * (1.0 - done))
    _report_job(result, stopped)
    if explain:
        _explain(result)
    try:
        _write(file, result, out)
    except OSError as error:  # a disk that filled: some writers do not say which file
        raise OSError(f"cannot write the picture into {out}: {error.strerror or error}") from error
    if beside is not None:
        _write_beside(file, result, beside, out)
    if result.nonfinite_pixels:
        _say(f"error: {result.nonfinite_pixels} pixels are not finite (magenta in the PNG)")
        raise typer.Exit(1)


def _report_job(result: rendering.Rendering, stopped: bool) -> None:
    """How good the picture is, for methods that know; and where a stopped or resumed one stands."""
    found = result.estimate.diagnostics
    if found.get("resumed_samples", 0):
        _say(f"resumed after {int(found['resumed_samples'])} samples a pixel of an earlier run")
    if "error" in found:
        spent = f"{int(result.estimate.num_samples)} samples a pixel"
        known = math.isfinite(found["error"])
        error = f"{float(found['error']):.2%}" if known else "unknown"
        _say(f"error {error} (standard error of 8 x 8 blocks over the mean) with {spent}")
    for line in result.skipped:
        if "warning:" in line:
            _say(line)
    if not bool(found.get("converged", True)):
        _say(f"warning: the solve did not converge, residual {float(np.max(found['residual'])):.1e}; allow more applications")
    if stopped:
        _say("stopped early; the same command goes on from here")


def _say(line: str) -> None:
    print(line, file=sys.stderr)


def _prepare(out: Path) -> None:
    """Fail before the work, not after it, where nothing can be written."""
    out.mkdir(parents=True, exist_ok=True)
    probe = out / ".jaxvol-write-test"
    jobs.write_bytes(probe, b"")
    probe.unlink()


def _explain(result: rendering.Rendering) -> None:
    for line in result.skipped:
        print(f"{result.method} skips: {line}")
    for share in result.shares:
        for claim, reason in zip(share.claims, share.reasons, strict=True):
            print(f"{share.method} computes {claim.name}: {reason}" + (f"; partly: {claim.partial}" if claim.partial else ""))
    for claim in () if result.shares else result.claims:
        print(f"{result.method} computes {claim.name}" + (f", partly: {claim.partial}" if claim.partial else ""))
    missing = rendering.unclaimed(result.claims)
    zero = [name for name in missing if name not in (*result.missing, *result.negligible)]
    if result.missing:
        print(f"{'nobody computes' if result.shares else f'{result.method} does not compute'} {', '.join(result.missing)}")
    if result.negligible:
        print(f"left out by a bound: {', '.join(result.negligible)}")
    if zero:
        print(f"zero in this scene and not computed: {', '.join(zero)}")


def _write(file: SceneFile, result: rendering.Rendering, out: Path) -> None:
    rgb = np.asarray(total(result.estimate.mean))
    exposure = None if file.render.exposure == "auto" else file.render.exposure
    about = {
        "scene": file.name,
        "method": result.method,
        "arguments": result.arguments,
        "seed": file.render.seed,
        "config": file.config,
        "versions": rendering.versions(),
    }
    stem = out / file.name
    exr, png, report = (stem.with_name(stem.name + suffix) for suffix in (".exr", ".png", ".json"))
    image.write_exr(exr, image.estimate_channels(result.estimate), metadata=about)
    exposure = image.write_png(png, rgb, exposure=exposure)
    first_picture = time.perf_counter() - jaxvol.STARTED
    jobs.write_json(
        report,
        about
        | {
            "seconds": result.seconds,
            "stages": result.stages,
            "shares": [
                {"method": share.method, "layers": [claim.name for claim in share.claims], "why": list(share.reasons)}
                for share in result.shares
            ],
            "missing": list(result.missing),
            "claims": [{"layers": claim.name, "partial": claim.partial} for claim in result.claims],
            "skipped": list(result.skipped),
            "nonfinite_pixels": result.nonfinite_pixels,
            "device": rendering.device(),
            "exposure": exposure,
            "seconds_to_first_picture": first_picture,
            "samples": None if result.estimate.num_samples is None else float(result.estimate.num_samples),
            "diagnostics": {name: _finite(value) for name, value in result.estimate.diagnostics.items()},
            "notes": list(file.notes),
        },
    )
    layers = [name for name, _ in items(result.estimate.mean)]
    print(f"{png}  (exposure {exposure:+.2f} stops)")
    print(f"{exr}  ({len(layers)} layers: {', '.join(layers)})")
    print(f"{report}")
    if result.missing and result.shares:
        _say(f"warning: nobody computes {', '.join(result.missing)}; the picture lacks this light")
    times = ", ".join(f"{name} {value:.1f} s" for name, value in result.seconds.items())
    print(f"{times}; first picture {first_picture:.1f} s after the start")


def _write_beside(file: SceneFile, result: rendering.Rendering, name: str, out: Path) -> None:
    """The same scene by another method, and both pictures side by side with one exposure, their times and difference."""
    with jobs.progress(f"{file.name}, {name}", total=1) as advance:
        other = rendering.render_scene(file, method=name)
        advance(1)
    exr, png = (out / f"{file.name}.{name}{suffix}" for suffix in (".exr", ".png"))
    image.write_exr(exr, image.estimate_channels(other.estimate), metadata={"scene": file.name, "method": other.method})
    pictures = [np.asarray(total(x.estimate.mean)) for x in (result, other)]
    exposure = image.choose_exposure(pictures[1]) if file.render.exposure == "auto" else file.render.exposure
    image.write_png(png, pictures[1], exposure=exposure)
    notes = [f"{x.method}, {x.seconds['plan'] + x.seconds['run']:.1f} s" for x in (result, other)]
    both = out / f"{file.name}.beside.png"
    picture_sheets.write_beside(both, pictures, notes, exposure=exposure)
    print(f"{both}  ({notes[0]} | {notes[1]})")
    names = sorted(set(NAMES) - set(rendering.unclaimed(result.claims)), key=NAMES.index)
    try:
        errors = image.compare(_as_picture(result), _as_picture(other), layers=names, block=4)
    except ValueError as error:
        _say(f"note: the pictures cannot be compared: {error}")
        return
    noise = errors["reference_noise"]
    print(
        f"difference over 4 x 4 pixels {errors['relative_l1']:.2%}, of the means {errors['bias']:+.2%}"
        + (f"; noise of {name} {noise:.2%}" if noise is not None else "")
    )


def _as_picture(result: rendering.Rendering) -> image.Picture:
    return image.Picture(
        rgb=np.asarray(total(result.estimate.mean)), layers=result.estimate.mean, variance=result.estimate.variance
    )


def _finite(value: object) -> object:
    """JSON has no NaN and no infinities: they become text."""
    array = np.asarray(value)
    if array.size > 64:
        return f"array {list(array.shape)}"
    plain = array.tolist()
    return plain if array.dtype.kind in "biu" or np.isfinite(array).all() else str(plain)
