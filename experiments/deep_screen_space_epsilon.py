"""Fig. 11: the threshold epsilon with and without blur, for both radii, with and without the open last shell.

    python experiments/deep_screen_space_epsilon.py [key=value ...]

Reference: all pairs of the same surfels with the same transport table, so that only the splat and the blur differ.
Writes out/deep_screen_space/epsilon.csv, epsilon.png (error against pairs) and epsilon_crops.png.
"""

import numpy as np
from deep_screen_space_common import config, layer, load, method, out, pictures, plt, write_csv


def main():
    """The sweep."""
    settings = config()
    problem, camera = load(settings["scene"], width=settings["width"], height=settings["height"])
    base = {"num_surfels": settings["surfels"]}
    every = layer(problem, camera, **base, num_levels=1, strides=(1,), dense_from=0, blur="none")
    rows, crops = [], {"none": [], "demodulated": []}
    for radius, tail in (("quadratic", True), ("quadratic", False), ("paper", True), ("paper", False)):
        for epsilon in settings["epsilons"]:
            for blur in ("none", "paper", "demodulated"):
                errors, biases, pairs = [], [], 0.0
                for seed in range(settings["seeds"]):
                    options = base | {"radius": radius, "tail": tail, "epsilon": epsilon, "blur": blur}
                    estimate = method.render(problem, camera, method.plan(problem, camera, **options), seed=seed)
                    image = np.asarray(estimate.mean.volume_from_surface)
                    errors.append(np.abs(image - every).sum() / every.sum())
                    biases.append(image.sum() / every.sum() - 1)
                    pairs = sum(float(v) for k, v in estimate.diagnostics.items() if k.startswith("pairs_"))
                rows.append([radius, tail, epsilon, blur, np.mean(errors), np.mean(biases), pairs])
                if radius == "quadratic" and tail and blur in crops:
                    crops[blur].append(image)
    write_csv("epsilon.csv", ["radius", "tail", "epsilon", "blur", "relative_l1", "bias", "pairs"], rows)
    fig, axes = plt.subplots(figsize=(8.0, 4.0), constrained_layout=True)
    for radius, tail in (("quadratic", True), ("quadratic", False), ("paper", True), ("paper", False)):
        for blur, style in (("none", ":"), ("paper", "--"), ("demodulated", "-")):
            line = [(r[6], r[4]) for r in rows if r[0] == radius and r[1] == tail and r[3] == blur]
            axes.loglog(*zip(*line, strict=True), style, marker="o", markersize=3, label=f"{radius}, tail {tail}, {blur}")
    axes.set_xlabel("pairs evaluated")
    axes.set_ylabel("relative L1 against all pairs")
    axes.legend(fontsize=6, loc="center left", bbox_to_anchor=(1.0, 0.5))
    fig.savefig(out("epsilon.png"), dpi=110)
    plt.close(fig)
    titles = [f"epsilon {e}" for e in settings["epsilons"]]
    pictures("epsilon_crops.png", [crops["none"], crops["demodulated"]], titles=titles, labels=["no blur", "blur"])


if __name__ == "__main__":
    main()
