"""Fig. 10: ours, the paper's mode and the reference, side by side, and errors against A1, A2 and A3 told apart.

    python experiments/deep_screen_space_comparison.py [key=value ...]

Writes out/deep_screen_space/comparison.csv, comparison_pairs.csv and comparison.png. A3 is the path tracer's layer at
pixel centres, compared over blocks of pixels; A1 (same surfels, exact pairs) and A2 (gathering by ray casting) at
single pixels.
"""

import numpy as np
from deep_screen_space_common import (
    PAPER,
    block_errors,
    blocks_with_medium,
    config,
    layer,
    load,
    method,
    path_traced,
    pictures,
    references,
    write_csv,
)


def against_a3(name, settings):
    """Rows of errors over blocks, and the three pictures (the reference only in its blocks)."""
    problem, camera = load(name, width=settings["width"], height=settings["height"])
    pixels = blocks_with_medium(problem, camera, size=settings["block"], num=settings["num_blocks"])
    mean, variance, seconds = path_traced(problem, camera, pixels, num_samples=settings["samples"])
    images = {"ours": layer(problem, camera), "paper": layer(problem, camera, **PAPER)}
    rows = []
    for label, image in images.items():
        error, bias, noise = block_errors(image, mean, variance, pixels)
        rows.append([name, label, "A3", error, bias, noise, seconds])
    reference = np.zeros((camera.height * camera.width, 3))
    reference[pixels] = mean
    masked = np.zeros_like(reference)
    masked[pixels] = images["ours"].reshape(-1, 3)[pixels]
    shape = (camera.height, camera.width, 3)
    return rows, [images["ours"], images["paper"], reference.reshape(shape), masked.reshape(shape)]


def against_pairs(name, settings):
    """Rows: ours against A1, ours against all its pairs, A1 against A2."""
    problem, camera = load(name, width=settings["width"], height=settings["height"])
    pixels = blocks_with_medium(problem, camera, size=1, num=settings["num_pair_pixels"]).reshape(-1)
    plan = method.plan(problem, camera, num_surfels=settings["pair_surfels"])
    ours = layer(problem, camera, num_surfels=settings["pair_surfels"]).reshape(-1, 3)[pixels]
    a1 = references.exact_pairs(problem, camera, plan, pixels)
    a2, error = references.gather(problem, camera, plan, pixels, num_directions=settings["directions"])
    relative = lambda a, r: (np.abs(a - r).sum() / r.sum(), a.sum() / r.sum() - 1)  # noqa: E731
    return [
        [name, "ours", "A1", *relative(ours, a1), 0.0],
        [name, "A1", "A2", *relative(a1, a2), error.sum() / a2.sum()],
        [name, "ours", "A2", *relative(ours, a2), error.sum() / a2.sum()],
    ]


def main():
    """All scenes."""
    settings = config()
    rows, pair_rows, shown = [], [], []
    for name in settings["scenes"]:
        if settings["num_blocks"]:
            found, images = against_a3(name, settings)
            rows += found
            shown.append(images)
            header = ["scene", "what", "reference", "relative_l1", "bias", "reference_noise", "reference_cpu_s"]
            write_csv("comparison.csv", header, rows)
        if settings["num_pair_pixels"]:
            pair_rows += against_pairs(name, settings)
            header = ["scene", "what", "reference", "relative_l1", "bias", "reference_noise"]
            write_csv("comparison_pairs.csv", header, pair_rows)
    if shown:
        titles = ["ours", "paper's mode", "path traced (blocks)", "ours in these blocks"]
        pictures("comparison.png", shown, titles=titles, labels=settings["scenes"])


if __name__ == "__main__":
    main()
