#!/usr/bin/env python3
"""Runs schemathesis with all checks on openapi.yaml against a real service that holds a mapped plant.

The exit code is that of schemathesis: 1 where the service does other than what its description says.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path += [str(ROOT / "tests" / "clients"), str(ROOT / "clients" / "python")]
from heliomap_client import Client  # noqa: E402
from service import Service, map_example  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--examples", type=int, default=50, help="most requests made up for each operation and phase")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="heliomap-contract-") as name, Service(Path(name) / "data") as service:
        client = Client(service.url, service.key)
        plant, survey, job = map_example(client, Path(name) / "survey", "Contract")
        features = client.call("GET", f"/api/v1/plants/{plant}/models/latest/modules?limit=1")["features"]
        environment = {
            **os.environ,
            "CONTRACT_PLANT": plant,
            "CONTRACT_SURVEY": survey,
            "CONTRACT_JOB": job["id"],
            "CONTRACT_MODULE": features[0]["id"],
            "CONTRACT_OWN_KEY": next(client.items("/api/v1/keys"))["id"],
            "PYTHONPATH": str(HERE),
        }
        command = [
            str(Path(sys.executable).parent / "schemathesis"),
            f"--config-file={HERE / 'schemathesis.toml'}",
            "run",
            str(ROOT / "openapi.yaml"),
            f"--url={service.url}",
            f"--header=Authorization: Bearer {service.key}",
            f"--max-examples={args.examples}",
            f"--seed={args.seed}",
        ]
        return subprocess.run(command, env=environment, cwd=name).returncode


if __name__ == "__main__":
    sys.exit(main())
