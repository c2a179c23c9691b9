"""Would a hierarchy over virtual lights pay? Sizes of lightcuts (Walter et al. 2005) against gathering every light.

A binary tree of the lights (split at the median of the longest axis) is cut for random points of a scene so that every
cluster's bound, strength * min(1/r^2, 1/d^2) * exp(-sigma_t r) at its nearest minus its farthest place, stays below a
share of the total. A cut visits about twice its size in nodes, each at best the cost of a pair of the gather kernel in
a loop that cannot be vectorised over lights: it pays where 2 * cut * penalty < number of lights.

Decision: not built. By this model a cut for every pixel costs as much as gathering 1,000 to 3,600 lights (2 % a cluster); one
choice of lights for the whole picture (`selection`, rows and columns of the light matrix) gathers about 1,100 of 27,000 in
the vectorised kernel and adds less noise than the paths themselves have (experiments/instant_equal_time.py).
Usage: python experiments/instant_hierarchy.py [--error 0.02] [--penalty 10].
"""

import argparse
import heapq

import numpy as np
from instant_common import cube, figure, floats, out_folder, square_camera, write_csv

from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import rendering
from jaxvol.methods.instant_multiple_scattering.virtual_lights import blocks

CLAMP = 0.35 / 3.0
SIGMA = 3.0


def tree_of(position, strength):
    """Nodes (low, high, strength, left, right), children -1 in leaves."""
    nodes = []

    def grow(rows):
        node = len(nodes)
        low, high = position[rows].min(axis=0), position[rows].max(axis=0)
        nodes.append([low, high, strength[rows].sum(), -1, -1])
        if len(rows) > 1:
            order = rows[np.argsort(position[rows, np.argmax(high - low)], kind="stable")]
            half = len(order) // 2
            nodes[node][3], nodes[node][4] = grow(order[:half]), grow(order[half:])
        return node

    grow(np.arange(len(position)))
    return nodes


def kernel(r):
    """Bounded geometry term and transmittance of the cube's medium."""
    return np.exp(-SIGMA * r) / np.maximum(r * r, CLAMP * CLAMP)


def error_of(node, x):
    """Bound on what replacing the cluster by one light can change."""
    low, high, strength, left, _ = node
    if left < 0:
        return 0.0
    near = np.linalg.norm(np.maximum(np.maximum(low - x, x - high), 0.0))
    far = np.linalg.norm(np.maximum(np.abs(low - x), np.abs(high - x)))
    return strength * (kernel(near) - kernel(far))


def cut_size(nodes, x, total, share):
    """Leaves of the cut at a point, for a bound of every cluster of `share` of the total."""
    heap = [(-error_of(nodes[0], x), 0)]
    while -heap[0][0] > share * total:
        _, node = heapq.heappop(heap)
        for child in nodes[node][3:]:
            heapq.heappush(heap, (-error_of(nodes[child], x), child))
    return len(heap)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--error", type=float, default=0.02)
    parser.add_argument("--penalty", type=float, default=10.0, help="scalar over vectorised cost of a pair")
    parser.add_argument("--points", type=int, default=64)
    arguments = parser.parse_args()
    scene = cube()
    points = np.random.default_rng(0).uniform(-1, 1, (arguments.points, 3))
    rows = []
    for number in (256, 1024, 4096, 16384):
        plan = ims.plan(scene, square_camera(8), num_paths=number)
        lights, _ = rendering.trace_lights(scene, None, plan, seed=3)
        position = np.concatenate([np.asarray(b.position) for _, b in blocks(lights)])
        strength = np.concatenate([np.asarray(b.strength)[:, 0] for _, b in blocks(lights)])
        position, strength = position[strength > 0], strength[strength > 0]
        nodes = tree_of(position, strength)
        distances = np.linalg.norm(points[:, None] - position[None], axis=-1)
        totals = (kernel(distances) * strength).sum(axis=1)
        cut = np.mean([cut_size(nodes, x, t, arguments.error) for x, t in zip(points, totals, strict=True)])
        rows.append([len(position), cut, 2 * cut * arguments.penalty / len(position)])
        print(*rows[-1], flush=True)
    write_csv(out_folder() / "hierarchy.csv", ["num_lights", "cut", "cost_over_full_gather"], rows)
    with figure(out_folder() / "hierarchy.png") as axes:
        count = floats(*(r[0] for r in rows))
        axes.loglog(count, count, "k--", label="every light")
        axes.loglog(count, [r[1] for r in rows], "o-", label=f"cut, {100 * arguments.error:g} % a cluster")
        axes.loglog(count, [2 * arguments.penalty * r[1] for r in rows], "s-", label="its cost in pairs of the kernel")
        axes.set_xlabel("virtual lights")
        axes.legend()


if __name__ == "__main__":
    main()
