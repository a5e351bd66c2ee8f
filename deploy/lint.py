#!/usr/bin/env python3
"""Checks the deployment files: the Dockerfile by hadolint, compose.yaml against the Compose specification, the Helm chart by
Helm's own lint and, rendered with several sets of values, against Kubernetes' schemas. Other kinds, such as
KEDA's ScaledObject, are checked for their kind only. Nothing is run: that takes a container engine and a cluster.
"""

import re
import subprocess
import sys
from pathlib import Path

import helm_python as helm
import kubernetes_validate
import yaml

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
CHART = HERE / "helm" / "heliomap"
BIN = Path(sys.executable).parent
KUBERNETES = ("1.30", "1.37")
#: Sets of values that together take every branch of the templates.
VALUES = {
    "as it is": {},
    "everything on": {
        "autoscaling": {"enabled": True},
        "blobs": {"endpoint": "https://store.example.org", "url": "s3://plants"},
        "env": {"HELIOMAP_LOG": "debug"},
        "image": {"tag": "1.2.3"},
        "imagePullSecrets": [{"name": "registry"}],
        "ingress": {"enabled": True, "className": "nginx", "tlsSecret": "tls", "annotations": {"a": "b"}},
        "server": {
            "replicas": 3,
            "storage": {"className": "fast"},
            "nodeSelector": {"disk": "ssd"},
            "env": {"A": "1"},
            "tolerations": [{"operator": "Exists"}],
            "affinity": {"podAntiAffinity": {}},
        },
        "serviceAccount": {"annotations": {"role": "r"}},
        "worker": {
            "nodeSelector": {"gpu": "no"},
            "tolerations": [{"operator": "Exists"}],
            "affinity": {"nodeAffinity": {}},
        },
    },
    "roles in place of keys": {"blobs": {"existingSecret": ""}, "metrics": {"scrapeAnnotations": False}},
    "a Prometheus with labels of its own": {"autoscaling": {"enabled": True, "matchers": 'app="demo"'}},
    "a gateway in front": {"server": {"behindProxy": True}},
    "an ingress that keeps addresses": {"ingress": {"enabled": True}, "server": {"behindProxy": False}},
    "a proxy by the environment": {"env": {"HELIOMAP_BEHIND_PROXY": "true"}},
}
#: Those in which servers take clients' addresses from a proxy.
BEHIND_PROXY = ("everything on", "a gateway in front", "a proxy by the environment")
#: Pods of the release that is rendered here, and of others in its namespace.
OWN_PODS = ("demo-heliomap-server-0", "demo-heliomap-server-12", "demo-heliomap-worker-7c9f8d6b5-x2x4z")
OTHER_PODS = (
    "heliomap-server-0",
    "other-demo-heliomap-server-0",
    "demo-heliomap-worker-b-server-0",
    "demo-heliomap-2-server-0",
)
#: Values that the chart's schema refuses.
REFUSED = (
    {"blobs": {"url": "https://bucket"}},
    {"database": {"existingSecret": ""}},
    {"server": {"replicas": 0}},
    {"typo": 1},
    {"server": {"behindProxy": "yes"}},
)


def merged(base: dict, more: dict) -> dict:
    both = dict(base)
    for key, value in more.items():
        both[key] = merged(both[key], value) if isinstance(value, dict) and isinstance(both.get(key), dict) else value
    return both


def run(*command: str) -> list[str]:
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    return [] if done.returncode == 0 else [f"{Path(command[0]).name}: {done.stdout}{done.stderr}"]


def secure(name: str, pod: dict) -> list[str]:
    """What a pod lacks of what this project promises."""
    wrongs = []
    if not pod["securityContext"].get("runAsNonRoot"):
        wrongs.append(f"{name} may run as root")
    for container in pod["containers"]:
        security = container["securityContext"]
        if (
            security["allowPrivilegeEscalation"]
            or not security["readOnlyRootFilesystem"]
            or security["capabilities"]["drop"] != ["ALL"]
        ):
            wrongs.append(f"{name} may do more than it needs to")
        if not container["resources"].get("limits", {}).get("memory"):
            wrongs.append(f"{name} has no limit of memory")
        if "livenessProbe" not in container:
            wrongs.append(f"{name} has no probe")
        for variable in container["env"]:
            if re.search("DATABASE|KEY|SECRET|PASSWORD", variable["name"]) and "valueFrom" not in variable:
                wrongs.append(f"{name} has {variable['name']} in the clear")
        names = [variable["name"] for variable in container["env"]]
        wrongs += [f"{name} has {variable} more than once" for variable in set(names) if names.count(variable) > 1]
    return wrongs


def scope(title: str, query: str) -> list[str]:
    """Where KEDA's query counts what other releases' pods say, or misses what this one's say."""
    if query.count("(") != query.count(")") or len(re.findall(r"heliomap_\w+", query)) != 3:
        return [f"{title}: the query is not the one that is checked here: {query}"]
    wrongs = []
    for metric in re.findall(r"heliomap_\w+", query):
        matchers = re.search(rf"{metric}{{([^}}]*)}}", query)
        labels = dict(re.findall(r'(\w+)=~?"([^"]*)"', matchers[1] if matchers else ""))
        if labels.get("app") == "demo":
            continue
        pods = {pod: bool(re.fullmatch(labels.get("pod", ".*"), pod)) for pod in (*OWN_PODS, *OTHER_PODS)}
        if labels.get("namespace") != "heliomap" or any(found != (pod in OWN_PODS) for pod, found in pods.items()):
            wrongs.append(f"{title}: {metric} counts the wrong pods: {labels}")
    return wrongs


def behind_proxy(pod: dict) -> bool:
    """Whether a server takes clients' addresses from a proxy."""
    return {"name": "HELIOMAP_BEHIND_PROXY", "value": "true"} in pod["containers"][0]["env"]


def check_chart() -> list[str]:
    wrongs = []
    defaults = yaml.safe_load((CHART / "values.yaml").read_text())
    result = helm.lint(CHART)
    messages = result.get("messages") or []
    wrongs += [
        f"helm lint: {message}"
        for message in messages
        if str(message.get("severity", "")).upper() in ("WARNING", "ERROR")
    ]
    wrongs += [f"helm lint: {error}" for error in result.get("errors") or []]
    kinds = set()
    with helm.Chart.load(CHART) as chart:
        for title, values in VALUES.items():
            values = merged(defaults, values)
            chart.validate_schema(values)
            rendered = chart.render(values=values, name="demo", namespace="heliomap")
            files = rendered.get("manifests", rendered) if isinstance(rendered, dict) else {"all": rendered}
            texts = files.values() if isinstance(files, dict) else files
            for text in texts:
                text = text if isinstance(text, str) else text.get("content", "")
                for document in yaml.safe_load_all(text) if "apiVersion" in text else ():
                    if not isinstance(document, dict):
                        continue
                    kind, name = document["kind"], document["metadata"]["name"]
                    kinds.add(kind)
                    if kind == "ScaledObject":
                        wrongs += scope(title, document["spec"]["triggers"][0]["metadata"]["query"])
                    if document["apiVersion"].startswith("keda.sh/"):
                        continue
                    for version in KUBERNETES:
                        try:
                            kubernetes_validate.validate(document, version, strict=True)
                        except kubernetes_validate.ValidationError as error:
                            wrongs.append(f"{title}, {kind} {name}, Kubernetes {version}: {error}")
                    if kind in ("Deployment", "StatefulSet"):
                        wrongs += secure(f"{title}, {kind} {name}:", document["spec"]["template"]["spec"])
                    if kind == "StatefulSet" and behind_proxy(document["spec"]["template"]["spec"]) != (
                        title in BEHIND_PROXY
                    ):
                        wrongs.append(f"{title}, {kind} {name}: clients' addresses are taken from the wrong place")
        for values in REFUSED:
            try:
                chart.validate_schema(merged(defaults, values))
            except helm.HelmError:
                continue
            wrongs.append(f"the chart takes {values}")
    expected = {
        "StatefulSet",
        "Deployment",
        "Service",
        "ServiceAccount",
        "Ingress",
        "ScaledObject",
        "PodDisruptionBudget",
    }
    wrongs += [f"no {kind} was rendered" for kind in sorted(expected - kinds)]
    return wrongs


def check_steps() -> list[str]:
    """The Dockerfile takes its steps from make, and names the Rust and the models that are used everywhere else."""
    text = (ROOT / "Dockerfile").read_text()
    return [
        f"the Dockerfile does not {step}"
        for step in (
            "RUN make web",
            "RUN make .ort/libonnxruntime.so",
            "RUN cargo build --release --locked --bin heliomap",
        )
        if step not in text
    ]


def main() -> int:
    wrongs = run(str(BIN / "hadolint"), "--config", str(HERE / "hadolint.yaml"), "Dockerfile")
    wrongs += run(str(BIN / "check-jsonschema"), "--builtin-schema", "vendor.compose-spec", "compose.yaml")
    wrongs += check_steps() + check_chart()
    for wrong in wrongs:
        print(f"WRONG: {wrong}")
    print(
        f"Dockerfile, compose.yaml and the Helm chart ({len(VALUES)} sets of values, Helm {helm.helm_sdk_version()}): "
        f"{len(wrongs)} wrong"
    )
    return 1 if wrongs else 0


if __name__ == "__main__":
    sys.exit(main())
