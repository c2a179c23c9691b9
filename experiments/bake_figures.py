"""The figures of Dubouchet et al. 2019 on baked light, from our bake: 1, 8, 9, 11, 12, and a lightmap against the path tracer.

`python experiments/bake_figures.py [--only street heterogeneous back_scattering probes homogeneous lightmap thickness]
[--quick]` writes bake_<name>.png, and errors against the path tracer into bake_<name>.csv where there is a reference.
`thickness` is the Cornell box filled with fog of .5, 2 and 6 mean free paths. Finished parts are kept in bake_<name>.parts.
"""

import argparse
import csv
import dataclasses
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import trimesh

from jaxvol import camera as cameras
from jaxvol import direct, image, jobs, layers, ray_casting
from jaxvol.methods import impulse_response, path_tracing
from jaxvol.methods.impulse_response import baking, lightmap, probes
from jaxvol.scene import load_scene, make_scene

HERE = Path(__file__).resolve().parent
DATA = HERE.parent / "../shared/data"
PAPER = {"image": False, "back_scattering": "epsilon", "occlusion": "drop", "contrast": None, "bounded": None}
PAPER |= {"similarity": True, "g_range": 0.5}


def write_csv(path, rows):
    with open(path, "w", newline="") as file:
        table = csv.DictWriter(file, fieldnames=list(rows[0]))
        table.writeheader()
        table.writerows(rows)


def errors(name, found, reference, variance):
    """One row: relative L1 and bias of irradiance [N, 3], and the reference's noise."""
    mean, truth = found.mean(axis=1, keepdims=True), reference.mean(axis=1, keepdims=True)
    row = {
        "what": name,
        "relative_l1": image.relative_l1(mean, truth),
        "bias": image.bias(mean, truth),
        "reference_noise": float(np.sqrt(variance.mean(axis=1)).sum() / truth.sum()),
    }
    print(", ".join(f"{key} {value:.2%}" if isinstance(value, float) else str(value) for key, value in row.items()), flush=True)
    return row


def kept(parts, label, make):
    """The arrays that `make` returns, from the store where an earlier run has finished them."""
    done = parts.get(label)
    if done is None:
        done = make()
        parts.put(label, done)
    return done


def mean_of(found):
    """The mean of every array over runs with other seeds."""
    return {name: sum(one[name] for one in found) / len(found) for name in found[0]}


def named(found):
    """What `traced` gives, as arrays to keep."""
    return dict(zip(("truth", "variance", "straight"), found, strict=True))


def traced(scene, points, normals, samples, *, seed=0):
    """Path-traced irradiance: (everything, its variance, what came straight from the sources)."""
    found = path_tracing.irradiance(scene, points + 1e-4 * normals, normals, samples=samples, seed=seed)
    parts = list(found.variance.sums.values())
    return np.asarray(layers.total(found.mean)), np.asarray(parts[0]), np.asarray(found.mean.emission)


def view(parts, label, scene, camera, *, samples, **options):
    """Surfaces by the bake and light that the medium scatters into the eye by `direct`; a surface-only bake has no medium."""
    if options.get("scattering") == "surface":
        scene = dataclasses.replace(scene, medium=None)
    plan = impulse_response.plan(scene, camera, **options)

    def baked(seed):
        found = impulse_response.render(scene, camera, plan, samples=min(samples, 16), seed=seed)
        return {"picture": np.asarray(layers.total(found.mean))}

    def seen():
        found = direct.render(scene, camera, direct.plan(scene, camera)).mean
        return {"picture": np.asarray(found.emission) + np.asarray(found.volume_from_light)}

    surfaces = [kept(parts, f"{label}-{seed}", lambda seed=seed: baked(seed)) for seed in range(max(1, samples // 16))]
    return mean_of(surfaces)["picture"] + kept(parts, f"{label}-direct", seen)["picture"]


def show(path, pictures, *, columns=None, exposure=None):
    """Pictures side by side with titles, one exposure for all."""
    first = next(iter(pictures.values()))
    exposure = image.choose_exposure(first) if exposure is None else exposure
    columns = columns or len(pictures)
    rows = -(-len(pictures) // columns)
    aspect = first.shape[0] / first.shape[1]
    figure, axes = plt.subplots(rows, columns, figsize=(4.6 * columns, rows * (4.6 * aspect + 0.4)), layout="constrained")
    for axis, (title, picture) in zip(np.ravel(axes), pictures.items(), strict=False):
        axis.imshow(image.tone_map(picture, exposure=exposure), interpolation="nearest")
        axis.set_title(title, fontsize=10)
    for axis in np.ravel(axes):
        axis.axis("off")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def canyon_file(width, *overrides):
    path = HERE / "scenes" / "street_canyon.toml"
    return load_scene(path, overrides=[f"camera.width={width}", f"camera.height={width * 3 // 4}", *overrides])


def street(out, quick, parts):
    """Like Figure 1: a street with lamps in fog, lit without the medium, with attenuated light, and with all of it."""
    file = canyon_file(120 if quick else 200)
    samples = 4 if quick else 64
    modes = {"surface-only bake": "surface", "attenuated only": "attenuated", "ours, all bounces in the medium": "multiple"}
    pictures = {
        title: view(parts, mode, file.scene, file.camera, samples=samples, scattering=mode) for title, mode in modes.items()
    }
    show(out / "bake_street.png", pictures)


def heterogeneous(out, quick, parts):
    """Figure 8: a dense ball of fog between lamps outside of it and a dark floor; light scattered onto the floor."""
    size = 24 if quick else 40
    x = (np.arange(48) + 0.5) / 24 - 1
    ball = (np.sqrt(sum(c * c for c in np.meshgrid(x, x, x, indexing="ij"))) < 0.9).astype(np.float32)
    floor = (np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], float), np.array([[0, 1, 2], [0, 2, 3]]))
    lamps = [{"kind": "point", "position": p, "intensity": 5.0} for p in ([-2.0, 0.3, 1.6], [1.2, 0.8, 2.6])]
    medium = {"density": ball, "bounds": [[-1, -1, 0.1], [1, 1, 2.1]], "scattering": 3.0, "absorption": 0.1}
    scene = make_scene({"shapes": [{"mesh": floor, "reflectance": 0.0}], "medium": medium, "lights": lamps}).scene
    place = (np.arange(size) + 0.5) / size * 6 - 3
    points = np.stack([*np.meshgrid(place, place, indexing="xy"), np.zeros((size, size))], axis=-1).astype(np.float32)
    normals = np.broadcast_to(np.float32([0, 0, 1]), points.shape)
    runs = [
        kept(parts, f"traced-{seed}", lambda seed=seed: named(traced(scene, points, normals, 512, seed=seed)))
        for seed in range(2 if quick else 16)
    ]
    mean = mean_of(runs)
    truth, straight, variance = mean["truth"], mean["straight"], mean["variance"] / len(runs)
    own = np.stack([run["truth"] - run["straight"] for run in runs])
    spread = own.var(axis=0, ddof=1) / len(runs)  # of scattered light, whose layer has no variance of its own
    pictures, rows = {"truth (path tracing)": truth}, []
    scattered = {"truth, scattered alone": truth - straight}
    for name, options in (("ours, segments marched", {}), ("paper: mean of each segment", PAPER)):
        # No random numbers are drawn where all is looked up.
        num_runs = 1 if quick or options else 8

        def baked(seed, options=options):
            samples = 64 if quick else 128
            found = impulse_response.irradiance(scene, points, normals, samples=samples, seed=seed, max_bounces=0, **options)
            straight = np.asarray(found.mean.surface_from_light)
            share = np.asarray(found.diagnostics["marched_share"])
            return {"total": np.asarray(layers.total(found.mean)), "straight": straight, "share": share}

        label = name.partition(" ")[0].strip(",:")
        found = mean_of([kept(parts, f"{label}-{seed}", lambda seed=seed: baked(seed)) for seed in range(num_runs)])
        total = found["total"]
        pictures[name] = total
        scattered[f"{name}, scattered alone"] = total - found["straight"]
        share = float(found["share"])
        rows.append(
            errors(name, total.reshape(-1, 3), truth.reshape(-1, 3), variance.reshape(-1, 3)) | {"marched_share": share}
        )
        light = errors(
            f"{name}, scattered alone",
            scattered[f"{name}, scattered alone"].reshape(-1, 3),
            (truth - straight).reshape(-1, 3),
            spread.reshape(-1, 3),
        )
        rows.append(light | {"marched_share": share})
    write_csv(out / "bake_heterogeneous.csv", rows)
    bright = {title: 4 * picture for title, picture in scattered.items()}
    show(out / "bake_heterogeneous.png", pictures | {f"{title} (x 4)": p for title, p in bright.items()}, columns=3)


def back_scattering(out, quick, parts):
    """Figure 9: light that the medium scatters, with and without patches beside and behind the receivers, and by the trick."""
    size = 24 if quick else 36
    floor = (np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], float), np.array([[0, 1, 2], [0, 2, 3]]))
    wall = (np.array([[-1.5, -9, 0], [-1.5, 9, 0], [-1.5, 9, 2], [-1.5, -9, 2]], float), np.array([[0, 1, 2], [0, 2, 3]]))
    shapes = [{"mesh": mesh, "reflectance": 0.8} for mesh in (floor, wall)]
    medium = {"density": 1.0, "bounds": [[-9, -9, 0], [9, 9, 9]], "scattering": 0.8, "absorption": 0.05}
    lamp = {"kind": "point", "position": [0.0, 0.0, 0.6], "intensity": 5.0}
    scene = make_scene({"shapes": shapes, "medium": medium, "lights": [lamp]}).scene
    place = (np.arange(size) + 0.5) / size * 6
    points = np.stack([*np.meshgrid(place - 1.49, place - 3, indexing="xy"), np.zeros((size, size))], axis=-1)
    points = points.astype(np.float32)
    normals = np.broadcast_to(np.float32([0, 0, 1]), points.shape)
    runs = [
        kept(parts, f"traced-{seed}", lambda seed=seed: named(traced(scene, points, normals, 256, seed=seed)))
        for seed in range(1 if quick else 8)
    ]
    mean = mean_of(runs)
    truth, straight, variance = mean["truth"], mean["straight"], mean["variance"] / len(runs)
    pictures, rows = {"truth, indirect": truth - straight}, []
    trick = {"back_scattering": "epsilon", "occlusion": "drop", "contrast": None, "bounded": None}
    cases = {"without back-scattering": {"back_scattering": False}, "with back-scattering": {}, "epsilon trick": trick}
    for name, options in cases.items():

        def baked(seed, options=options):
            samples = 64 if quick else 128
            found = impulse_response.irradiance(scene, points, normals, samples=samples, seed=seed, **options)
            return {"total": np.asarray(layers.total(found.mean)), "straight": np.asarray(found.mean.surface_from_light)}

        label = name.partition(" ")[0]
        found = mean_of([kept(parts, f"{label}-{i}", lambda i=i, baked=baked: baked(i)) for i in range(1 if quick else 4)])
        total = found["total"]
        pictures[name] = total - found["straight"]
        rows.append(errors(name, total.reshape(-1, 3), truth.reshape(-1, 3), variance.reshape(-1, 3)))
    exposure = image.choose_exposure(pictures["truth, indirect"])
    show(out / "bake_back_scattering.png", pictures, exposure=exposure)
    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for axis, row in zip(axes, rows, strict=True):
        difference = (pictures[row["what"]] - pictures["truth, indirect"]).mean(axis=-1) / truth.mean(axis=-1)
        shown = axis.imshow(difference, cmap="RdBu_r", vmin=-0.3, vmax=0.3)
        axis.set_title(f"{row['what']}: error of irradiance {row['relative_l1']:.1%}", fontsize=9)
        axis.axis("off")
    figure.colorbar(shown, ax=axes, label="difference / truth")
    figure.savefig(out / "bake_back_scattering_error.png", dpi=80)
    plt.close(figure)
    write_csv(out / "bake_back_scattering.csv", rows)


def probe_lit(out, quick, parts):
    """Figure 11: a mesh that is not in the bake, lit by interpolated probes, without and with the medium."""
    path = DATA / "meshes" / "suzanne_cc0.ply"
    mesh = trimesh.load(path, force="mesh") if path.exists() else trimesh.creation.icosphere(subdivisions=4)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_scale(0.9 / mesh.extents.max())
    mesh.apply_translation([0.1, 0.95, 0.1])
    overrides = ["medium.scattering=0.9", "medium.absorption=0.05", "camera.width=200", "camera.height=200"]
    overrides += ["camera.fov_y=15.0"]
    file = load_scene(HERE / "scenes" / "cornell_fog.toml", overrides=overrides)
    body = make_scene({"shapes": [{"mesh": (np.asarray(mesh.vertices), np.asarray(mesh.faces)), "reflectance": 0.8}]}).scene
    low, step, shape = probes.grid([[-0.95, 0.05, -0.95], [0.95, 1.95, 0.95]], 0.95 if quick else 0.32)
    facing, _ = probes.directions()
    where = probes.positions(low, step, shape).reshape(-1, 3)
    points = np.repeat(where, len(facing), axis=0).astype(np.float32)
    normals = np.tile(facing, (len(where), 1)).astype(np.float32)
    caster = ray_casting.caster_for(body.mesh)
    pixel = cameras.pixel_centers(file.camera)
    rays = cameras.generate_rays(file.camera, pixel)
    t, face = ray_casting.intersect(caster, rays.origin, rays.direction, jnp.full(pixel.shape[0], jnp.inf))
    hits = ray_casting.hits(body.mesh, rays.origin, rays.direction, jnp.asarray(t), jnp.asarray(face))
    smooth = _smooth_normals(mesh, np.asarray(hits.position), np.asarray(hits.face))
    pictures = {}
    for name, mode in (
        ("surfaces alone", "surface"),
        ("attenuated", "attenuated"),
        ("with light scattered in the fog", "multiple"),
    ):
        plan = impulse_response.plan(file.scene, None, scattering=mode, max_bounces=3, image=False)  # probes are no surfaces
        found = baking.bake(
            impulse_response.prepare(file.scene, plan), plan, points, normals, name=mode, samples=8 if quick else 64
        )
        light = probes.radiance_from_irradiance(baking.total(found).reshape(*shape, -1, 3))
        lit = probes.relight(probes.Probes(low, step, light), np.asarray(hits.position), smooth)
        picture = np.where(np.asarray(hits.valid)[:, None], 0.8 / np.pi * lit, 0.0)
        pictures[name] = picture.reshape(file.camera.height, file.camera.width, 3)
    show(out / "bake_probes.png", pictures)


def _smooth_normals(mesh, points, faces):
    corners = np.asarray(mesh.triangles)[np.maximum(faces, 0)]
    weight = trimesh.triangles.points_to_barycentric(corners, np.where((faces >= 0)[:, None], points, corners.mean(axis=1)))
    normal = np.einsum("nk,nkd->nd", weight, np.asarray(mesh.vertex_normals)[np.asarray(mesh.faces)[np.maximum(faces, 0)]])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)


def homogeneous(out, quick, parts):
    """Figure 12: attenuated light alone against everything, with the eye rays' scattering by `direct`; lamps, then a sun."""
    width, samples = (100, 4) if quick else (160, 64)
    lamps = canyon_file(width)
    sun = make_sun(lamps)
    pictures = {}
    for name, scene in (("lamps", lamps.scene), ("sun", sun)):
        for title, mode in (("attenuated only", "attenuated"), ("ours", "multiple")):
            label = f"{name}_{mode}"
            pictures[f"{name}: {title}"] = view(parts, label, scene, lamps.camera, samples=samples, scattering=mode)
    show(out / "bake_homogeneous.png", pictures, columns=2)


def make_sun(file):
    """The same street in the low sun, without lamps and sky."""
    sun = make_scene({"lights": [{"kind": "directional", "direction": [0.8, 0.25, -0.5], "irradiance": [9.0, 7.5, 6.0]}]}).scene
    names = {"point_lights": None, "spot_lights": None, "environment": None, "directional_lights": sun.directional_lights}
    return dataclasses.replace(file.scene, **names)


def lightmap_against_reference(out, quick, parts):
    """Irradiance at the texels of the Cornell box in fog, a bounded medium: the bake, the path tracer, and errors by mode."""
    file = load_scene(HERE / "scenes" / "cornell_fog.toml")
    what = lightmap.unwrap(file.scene.mesh, resolution=32 if quick else 48)
    reference = partial(traced, file.scene, what.receiver, what.normal, 128 if quick else 4096)
    done = kept(parts, "traced", lambda: named(reference()))
    truth, variance = done["truth"], done["variance"]
    rows, pictures = [], {"path tracing": _atlas(what, truth)}
    cases = {
        "ours": {},
        "tables alone": {"occlusion": "drop", "bounded": None},
        "paper": PAPER,
        "attenuated only": {"scattering": "attenuated"},
        "surface-only": {"scattering": "surface"},
    }
    for name, options in cases.items():
        plan = impulse_response.plan(file.scene, None, **options)
        found = baking.bake(
            impulse_response.prepare(file.scene, plan),
            plan,
            what.receiver,
            what.normal,
            name=name,
            samples=64 if quick else 1024,
        )
        rows.append(errors(f"cornell_fog, {name}", baking.total(found), truth, variance) | found.shares)
        pictures[f"{name}: {rows[-1]['relative_l1']:.1%}"] = _atlas(what, baking.total(found))
    write_csv(out / "bake_lightmap.csv", rows)
    show(out / "bake_lightmap.png", pictures, columns=3)


def thickness(out, quick, parts):
    """Bias of the Cornell box's mean irradiance by the mean free paths of fog that fill it: as baked, and by tables alone."""
    rows = []
    for across in (0.5, 2.0, 6.0):
        sigma = across / 2  # the box is 2 wide
        overrides = [f"medium.scattering={0.96 * sigma}", f"medium.absorption={0.04 * sigma}"]
        file = load_scene(HERE / "scenes" / "cornell_fog.toml", overrides=overrides)
        what = lightmap.unwrap(file.scene.mesh, resolution=24)
        reference = partial(traced, file.scene, what.receiver, what.normal, 128 if quick else 2048)
        done = kept(parts, f"traced-{across:g}", lambda reference=reference: named(reference()))
        truth, variance = done["truth"], done["variance"]
        num_runs = 1 if quick else 8
        for name, options in (("ours", {}), ("tables alone", {"bounded": None, "occlusion": "drop"})):
            plan = impulse_response.plan(file.scene, None, **options)
            kit = impulse_response.prepare(file.scene, plan)

            def baked(seed, kit=kit, plan=plan, what=what):
                found = baking.bake(kit, plan, what.receiver, what.normal, name="", samples=64, seed=seed)
                return {"total": baking.total(found), "variance": found.variance}

            label = f"{name.partition(' ')[0]}-{across:g}"
            runs = [kept(parts, f"{label}-{seed}", lambda seed=seed, baked=baked: baked(seed)) for seed in range(num_runs)]
            found = mean_of(runs)
            own = float(np.sqrt(found["variance"].mean(axis=1).sum() / num_runs) / found["total"].mean(axis=1).sum())
            row = errors(f"{across:g} mean free paths, {name}", found["total"], truth, variance)
            noise = float(np.sqrt(variance.mean(axis=1).sum()) / truth.mean(axis=1).sum())
            rows.append(row | {"noise_of_bias": float(np.hypot(own, noise))})
    write_csv(out / "bake_thickness.csv", rows)
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for name in ("ours", "tables alone"):
        chosen = [row for row in rows if row["what"].endswith(name)]
        axis.errorbar((0.5, 2.0, 6.0), [r["bias"] for r in chosen], [r["noise_of_bias"] for r in chosen], fmt="o-", label=name)
    axis.set(xlabel="mean free paths across the box", ylabel="bias of mean irradiance", xscale="log")
    axis.legend()
    figure.savefig(out / "bake_thickness.png", dpi=80)
    plt.close(figure)


def _atlas(what, values):
    whole = np.zeros((*what.covered.shape, 3), np.float32)
    whole[what.covered] = values
    return lightmap.dilate(whole, what.covered)


FIGURES = {
    "street": street,
    "heterogeneous": heterogeneous,
    "back_scattering": back_scattering,
    "probes": probe_lit,
    "homogeneous": homogeneous,
    "lightmap": lightmap_against_reference,
    "thickness": thickness,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=list(FIGURES), default=list(FIGURES))
    parser.add_argument("--quick", action="store_true", help="small and noisy")
    parser.add_argument("--out", type=Path, default=Path("out"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.only:
        parts = jobs.Parts(arguments.out / f"bake_{name}{'_quick' * arguments.quick}.parts", config={"quick": arguments.quick})
        FIGURES[name](arguments.out, arguments.quick, parts)
        print("wrote", arguments.out / f"bake_{name}.png", flush=True)


if __name__ == "__main__":
    main()
