"""Peak memory and CPU seconds of one 1920x1080 picture with about 4,000 virtual lights (CSV).

Usage: python experiments/instant_memory.py [--upsample 8] [--width 1920] [--height 1080].
"""

import argparse
import dataclasses
import resource
import time

from instant_common import cube, out_folder, square_camera, write_csv

from jaxvol.methods import instant_multiple_scattering as ims


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--upsample", type=int, default=8)
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--height", type=int, default=1080)
    arguments = parser.parse_args()
    scene = cube()
    camera = dataclasses.replace(square_camera(8), height=arguments.height, width=arguments.width)
    plan = ims.plan(scene, camera, num_paths=2560, max_lights=None, upsample=arguments.upsample)
    start = time.process_time()
    estimate = ims.render(scene, camera, plan)
    seconds = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    row = [arguments.width, arguments.height, arguments.upsample, int(estimate.diagnostics["num_lights"]), peak, seconds]
    print(*row)
    header = ["width", "height", "upsample", "num_lights", "peak_MiB", "cpu_s"]
    write_csv(out_folder() / f"memory_{arguments.upsample}.csv", header, [row])


if __name__ == "__main__":
    main()
