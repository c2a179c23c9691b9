"""What skipping is worth: each thing that a scene may lack, with the seconds and the compiled operations with and without it.

    python experiments/skipping.py [NAME ...] [--out DIR]

Each side runs in a process of its own, without the compilation cache, and XLA writes down the programs that it compiles:
`operations` counts their instructions before optimization, `modules` the programs. Seconds are warm, the median of five calls
(of fewer where they take more than six seconds together).
Finished rows are kept in DIR/rows.json; `--again` forgets them.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

ENOUGH = 6.0  # seconds of warm calls
BLACK = 1e-6  # radiance below which pictures are black; the lamps' is about 1
SIGMAS = 4.0  # standard errors by which the means of two noisy pictures may differ, in the worst of 9 layers and 3 channels
DEAR = ("gather", "scatter", "sort", "while", "log", "exponential", "power", "divide", "sqrt", "dot")


def find(name):
    from jaxvol.benchmark.skips import SKIPS

    return next(skip for skip in SKIPS if skip.name == name)


def run_side(name, side, picture):
    """In a process of its own: render, and print seconds as JSON."""
    import numpy as np

    from jaxvol import rendering
    from jaxvol.layers import total
    from jaxvol.scene import make_scene

    skip = find(name)
    config = skip.present if side == "with" else skip.absent
    options = skip.options | (skip.without if side == "without" else {})
    file = make_scene(config | {"render": skip.render(options)})
    result = rendering.render_scene(file, method=skip.method)
    seconds = []
    while len(seconds) < 5 and sum(seconds) < ENOUGH:
        start = time.perf_counter()
        warm = rendering.render_scene(file, method=skip.method)
        seconds.append(time.perf_counter() - start)
    np.savez(picture, total=np.asarray(total(warm.estimate.mean)), **means(warm.estimate))
    print(json.dumps({"seconds": statistics.median(seconds), "compile": result.seconds["compile"], "skipped": warm.skipped}))


def means(estimate):
    """The means over the picture of all layers (0 where there is none), and their standard errors, both [9, 3]."""
    import numpy as np

    from jaxvol.layers import NAMES

    def pixels(layers, name):
        values = None if layers is None else getattr(layers, name)
        return np.zeros((1, 3)) if values is None else np.asarray(values).reshape(-1, 3)

    variance = [pixels(estimate.variance, name) for name in NAMES]
    return {
        "mean": np.stack([pixels(estimate.mean, name).mean(axis=0) for name in NAMES]),
        "error": np.stack([np.sqrt(layer.sum(axis=0)) / len(layer) for layer in variance]),
    }


def operations(folder):
    """Instructions by opcode in all programs that XLA compiled, before optimization."""
    counts, modules = Counter(), 0
    for path in Path(folder).glob("*before_optimizations.txt"):
        modules += 1
        counts.update(re.findall(r" = [^=\n]*? ([a-z][a-z0-9-]*)\(", path.read_text()))
    return counts, modules


def measure(name, side):
    """Seconds, operations and the picture of one side."""
    import numpy as np

    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "picture.npz"
        environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
        environment["XLA_FLAGS"] = f"--xla_dump_to={folder} --xla_dump_hlo_as_text --xla_dump_hlo_module_re=.*"
        command = [sys.executable, __file__, "--one", name, side, str(picture)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{name}, {side}: {done.stderr.strip().splitlines()[-1]}")
        found = json.loads(done.stdout.splitlines()[-1])
        counts, modules = operations(folder)
        found |= {"operations": sum(counts.values()), "modules": modules, "dear": {k: counts[k] for k in DEAR}}
        with np.load(picture) as arrays:
            return found, dict(arrays)


def row_of(skip):
    """Both sides of a skip."""
    import numpy as np

    (ours, a), (theirs, b) = (measure(skip.name, side) for side in ("with", "without"))
    if skip.equal is None:
        apart, error = np.abs(a["mean"] - b["mean"]), np.hypot(a["error"], b["error"])
        difference, limit = float((apart / (error + BLACK)).max()), SIGMAS
    else:
        apart, size = np.abs(a["total"] - b["total"]).mean(), np.abs(b["total"]).mean()
        difference, limit = float(apart / max(size, BLACK)), skip.equal
    row = {"name": skip.name, "method": skip.method, "what": skip.what, "with": ours, "without": theirs}
    return row | {"difference": difference, "noisy": skip.equal is None, "equal": difference <= limit}


def show(rows):
    """The table."""
    head = (
        f"{'lacks':24s} {'method':28s} {'with s':>7s} {'without':>8s} {'gain':>6s} {'operations':>16s} {'picture':>9s}  skipped"
    )
    print(head)
    for row in rows:
        a, b = row["with"], row["without"]
        operations_ = f"{a['operations']} / {b['operations']}"
        picture = f"{row['difference']:.1f} sd" if row["noisy"] else f"{row['difference']:.1e}"
        print(
            f"{row['name']:24s} {row['method']:28s} {a['seconds']:7.3f} {b['seconds']:8.3f} "
            f"{b['seconds'] / a['seconds']:5.2f}x {operations_:>16s} {picture:>9s}  {row['what']}"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--out", type=Path, default=Path("out/skipping"))
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        run_side(*chosen.one)
        return
    from jaxvol.benchmark.skips import SKIPS

    chosen.out.mkdir(parents=True, exist_ok=True)
    path = chosen.out / "rows.json"
    rows = {} if chosen.again or not path.exists() else {row["name"]: row for row in json.loads(path.read_text())}
    for skip in SKIPS:
        if (not chosen.names or skip.name in chosen.names) and skip.name not in rows:
            rows[skip.name] = row_of(skip)
            print(f"{skip.name}: done", file=sys.stderr, flush=True)
            path.write_text(json.dumps(list(rows.values()), indent=1))
    ordered = [rows[skip.name] for skip in SKIPS if skip.name in rows]
    show(ordered)
    raise SystemExit(0 if all(row["equal"] for row in ordered) else 1)


if __name__ == "__main__":
    main()
