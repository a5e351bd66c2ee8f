#!/usr/bin/env python3
"""Maps the example plant from its photos alone, on the command line, and compares it with the truth."""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

EXAMPLE = Path(__file__).resolve().parent / "plant"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--binary", type=Path, required=True, help="the program")
    binary = parser.parse_args().binary.resolve()
    with tempfile.TemporaryDirectory() as folder:
        survey, plant = Path(folder) / "survey", Path(folder) / "plant.geojson"
        shutil.copytree(EXAMPLE / "images", survey / "images")
        begun = time.monotonic()
        subprocess.run([binary, "map", survey, "--reconstruct", "--out", plant], check=True)
        print(f"mapped from photos alone in {time.monotonic() - begun:.0f} s; compared with the truth:", flush=True)
        return subprocess.run([binary, "evaluate", plant, EXAMPLE / "truth.json", "--strict"]).returncode


if __name__ == "__main__":
    sys.exit(main())
