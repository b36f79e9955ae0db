"""Whether a long run's memory, files and threads stay as they are, seen from outside.

    python tests/benchmarks/long_run.py --minutes 60 --out long_run.csv giril task=hopper

starts ``giril run`` with so many steps that it does not end by itself, looks at it in ``/proc``
(Linux only) every few seconds, stops it as Ctrl-C does and prints how fast each figure grew in the
second half, when caches are full. The run's folder is temporary.
"""

import argparse
import csv
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COLUMNS = ("seconds", "rss_mib", "descriptors", "threads", "folder_mib", "metrics_rows")


def look(pid: int, folder: Path, began: float) -> dict[str, float]:
    """One row of the table."""
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    rows = 0
    for path in folder.rglob("metrics.jsonl"):
        with open(path, "rb") as file:
            rows += sum(1 for _ in file)
    return {
        "seconds": round(time.monotonic() - began, 1),
        "rss_mib": int(status["VmRSS"].split()[0]) / 1024,
        "descriptors": len(os.listdir(f"/proc/{pid}/fd")),
        "threads": int(status["Threads"]),
        "folder_mib": sum(sizes) / 2**20,
        "metrics_rows": rows,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recipe")
    parser.add_argument("knobs", nargs="*", metavar="key=value")
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--every", type=float, default=10, help="seconds between looks")
    parser.add_argument("--out", type=Path, default=Path("long_run.csv"))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        knobs = {word.split("=")[0]: word for word in ["steps=2000000000", *args.knobs]}
        place = f"root={temporary}", f"out={temporary}/run"
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "giril_rl.cli.command_line",
                "run",
                args.recipe,
                *knobs.values(),
                *place,
            ],
            stdout=subprocess.DEVNULL,
        )
        rows = []
        began = time.monotonic()
        try:
            with open(args.out, "w", newline="") as file:
                table = csv.DictWriter(file, COLUMNS)
                table.writeheader()
                while time.monotonic() - began < 60 * args.minutes:
                    time.sleep(args.every)
                    if process.poll() is not None:
                        break
                    rows.append(look(process.pid, Path(temporary), began))
                    table.writerow(rows[-1])
                    file.flush()
            process.send_signal(signal.SIGTERM)
            process.wait(120)
        finally:
            process.kill()
            process.wait()
    late = rows[len(rows) // 2 :]
    if len(late) < 2:
        print(f"the run ended at once, exit code {process.returncode}")
        return 1
    print(f"{rows[-1]['seconds']:,.0f} s, exit code {process.returncode}, table in {args.out}")
    for name in COLUMNS[1:]:
        figures = [row[name] for row in late]
        slope = statistics.linear_regression([row["seconds"] for row in late], figures).slope
        ends = f"{figures[0]:,.1f} to {figures[-1]:,.1f}"
        print(f"{name:<13} {ends:<22} {3600 * slope:+,.2f} an hour")
    return 0 if process.returncode == 130 else 1


if __name__ == "__main__":
    sys.exit(main())
