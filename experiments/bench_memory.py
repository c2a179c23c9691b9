"""Peak memory of a 1920 x 1080 render with the path tracer, as a user would run it.

    python experiments/bench_memory.py [SCENE.toml] [--samples 4] [--interrupt SECONDS] [--set KEY=VALUE ...]

Runs `jaxvol render` in a process of its own and prints its peak resident memory (target: below 2 GB); `--interrupt`
sends it Ctrl-C after so many seconds, so that it also writes its accumulators, and runs it again to the end.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent


def run(command, interrupt=None):
    """Peak resident memory of the process in MiB, its wall seconds and exit status."""
    start = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    if interrupt is not None:
        time.sleep(interrupt)
        process.send_signal(signal.SIGINT)
    _, status, usage = os.wait4(process.pid, 0)
    return usage.ru_maxrss / 1024, time.monotonic() - start, os.waitstatus_to_exitcode(status)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, nargs="?", default=HERE / "scenes/cornell_fog.toml")
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--height", type=int, default=1080)
    parser.add_argument("--interrupt", type=float, default=None)
    parser.add_argument("--set", action="append", default=[])
    arguments = parser.parse_args()
    size = [f"camera.width={arguments.width}", f"camera.height={arguments.height}", *arguments.set]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "jaxvol", "render", str(arguments.scene), "--out", folder]
        command += ["--samples", str(arguments.samples)]
        command += [word for setting in size for word in ("--set", setting)]
        for number in range(1 if arguments.interrupt is None else 2):
            peak, seconds, status = run(command, arguments.interrupt if number == 0 else None)
            print(f"{arguments.scene.stem} {arguments.width} x {arguments.height}, {arguments.samples} samples:", end=" ")
            print(f"peak {peak:.0f} MiB, {seconds:.0f} s, exit status {status}", flush=True)


if __name__ == "__main__":
    main()
