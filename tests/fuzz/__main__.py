"""``python -m tests.fuzz N``: run N damaged inputs; exit code 1 where one did what none may do."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.update(
    dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS", "MARCHA_THREADS"), "1")
)


def main() -> int:
    """Run as the arguments say."""
    from .run import report, run

    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("inputs", type=int, nargs="?", default=10_000)
    parser.add_argument("--seed", type=int, default=1, help="another seed gives other inputs")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", default="", help="targets whose name has this")
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--keep", type=Path, help="folder for the input of each failure")
    parser.add_argument("--log", type=Path, help="file for a line a failure, as it is found")
    parser.add_argument("--times", action="store_true", help="processor time by target")
    given = parser.parse_args()
    result = run(
        given.inputs,
        seed=given.seed,
        jobs=min(given.jobs, given.inputs),
        only=given.only,
        first=given.first,
        keep=given.keep,
        log=given.log,
    )
    if given.times:
        for name, (count, used) in sorted(result.by_target.items(), key=lambda t: -t[1][1] / t[1][0]):
            print(f"{name:40} {count:7.0f} inputs, {1e3 * used / count:7.1f} ms each")
    report(result, given.seed)
    return int(bool(result.failures))


if __name__ == "__main__":
    sys.exit(main())
