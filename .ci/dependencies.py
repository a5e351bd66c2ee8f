#!/usr/bin/env python3
"""Checks licences, sources and bans of deny.toml against Cargo.lock, and that the lower crates stay free of services.

`make deny` runs cargo-deny, which checks more (advisories, texts of licences) and takes minutes to install. This check
takes a second, so that `make lint` can run it.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import tomllib

ROOT = Path(__file__).resolve().parent.parent

# Crates of the mapping and the model must be usable without a runtime, a server or a database (docs/ARCHITECTURE.md).
LOWER = ("heliomap-model", "heliomap-mapping")
SERVICE_CRATES = {"tokio", "axum", "hyper", "reqwest", "sqlx", "object_store", "utoipa", "clap"}


def is_allowed(expression: str, allowed: set[str]) -> bool:
    """Whether an SPDX expression can be met by allowed licences alone."""
    expression = re.sub(r"\s*/\s*", " OR ", expression)
    terms = re.split(r"\s+(OR|AND)\s+|([()])", expression)
    python = []
    for term in (term.strip() for term in terms if term and term.strip()):
        python.append({"OR": "or", "AND": "and", "(": "(", ")": ")"}.get(term, str(term in allowed)))
    return bool(eval(" ".join(python), {"__builtins__": {}}))  # only True, False, and, or, brackets


def main() -> int:
    rules = tomllib.loads((ROOT / "deny.toml").read_text())
    metadata = json.loads(
        subprocess.run(
            ["cargo", "metadata", "--format-version", "1", "--locked"], cwd=ROOT, check=True, stdout=subprocess.PIPE
        ).stdout
    )
    packages = {package["id"]: package for package in metadata["packages"]}
    normal = {
        node["id"]: [
            dependency["pkg"]
            for dependency in node["deps"]
            if any(kind["kind"] is None for kind in dependency["dep_kinds"])
        ]
        for node in metadata["resolve"]["nodes"]
    }
    parents: dict[str, set[str]] = {}
    for node in metadata["resolve"]["nodes"]:
        for dependency in node["deps"]:
            parents.setdefault(packages[dependency["pkg"]]["name"], set()).add(packages[node["id"]]["name"])

    faults = []
    allowed = set(rules["licenses"]["allow"])
    for package in packages.values():
        name = f"{package['name']} {package['version']}"
        if package["source"] is None:
            continue
        if package["source"] != "registry+https://github.com/rust-lang/crates.io-index":
            faults.append(f"{name} comes from {package['source']}, not from crates.io")
        if not package["license"] or not is_allowed(package["license"], allowed):
            faults.append(f"{name} has the licence {package['license']}, which deny.toml does not allow")
    for ban in rules["bans"]["deny"]:
        for parent in sorted(parents.get(ban["crate"], set()) - set(ban.get("wrappers", []))):
            faults.append(f"{parent} depends on {ban['crate']}: {ban['reason']}")
    for package in packages.values():
        if package["name"] in LOWER:
            seen, stack = set(), [package["id"]]
            while stack:
                for dependency in normal[stack.pop()]:
                    if dependency not in seen:
                        seen.add(dependency)
                        stack.append(dependency)
            for name in sorted({packages[dependency]["name"] for dependency in seen} & SERVICE_CRATES):
                faults.append(f"{package['name']} depends on {name}, which belongs to the service")
    for fault in faults:
        print(f"dependencies: {fault}", file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
