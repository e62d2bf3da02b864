"""What `deploy/` holds is what Kubernetes, Prometheus, Grafana and Compose take, of this code."""

import json
import re
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import kubernetes_validate
import promql_parser
import pytest
import yaml
from compose_spec import PyOptions
from starlette.testclient import TestClient

from service.settings import Settings
from store import housekeeping
from store.settings import StoreSettings
from worker.settings import WorkerSettings

ROOT = Path(__file__).parents[3]
DEPLOY = ROOT / "deploy"
KUBERNETES = DEPLOY / "kubernetes"
CUSTOM = {"ScaledObject", "Kustomization"}  # of whose schemas no package is known
# Of Prometheus, and what it adds to every series.
ITS_OWN, ITS_LABELS = {"up"}, {"job", "instance", "le"}
MANIFESTS = [
    manifest
    for file in sorted(KUBERNETES.glob("*.yaml"))
    for manifest in yaml.safe_load_all(file.read_text())
]
RULES = [
    rule
    for group in yaml.safe_load((DEPLOY / "prometheus" / "alerts.yaml").read_text())["groups"]
    for rule in group["rules"]
]
DASHBOARD = json.loads((DEPLOY / "grafana" / "dashboard.json").read_text())
EXPRESSIONS = [rule["expr"] for rule in RULES] + [
    target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]
]


def of_kind(kind: str) -> list[dict[str, Any]]:
    return [manifest for manifest in MANIFESTS if manifest["kind"] == kind]


def workloads() -> list[dict[str, Any]]:
    return of_kind("Deployment") + of_kind("Job")


@pytest.mark.parametrize(
    "manifest",
    MANIFESTS,
    ids=lambda m: f"{m['kind']}-{m['metadata']['name']}" if "metadata" in m else m["kind"],
)
def test_manifests_are_of_kubernetes_own_schemas(manifest: dict[str, Any]) -> None:
    if manifest["kind"] not in CUSTOM:
        kubernetes_validate.validate(manifest, "1.37.0", strict=True)
        with pytest.raises(kubernetes_validate.ValidationError):  # it is looked at at all
            kubernetes_validate.validate(manifest | {"specs": {}}, "1.37.0", strict=True)


def test_all_files_are_applied_to_one_namespace() -> None:
    kustomization = of_kind("Kustomization")[0]
    files = {file.name for file in KUBERNETES.glob("*.yaml")} - {"kustomization.yaml"}
    assert set(kustomization["resources"]) == files
    for manifest in MANIFESTS:
        if manifest["kind"] not in ("Kustomization", "Namespace"):
            assert manifest["metadata"]["namespace"] == kustomization["namespace"]


@pytest.mark.parametrize("workload", workloads(), ids=lambda w: w["metadata"]["name"])
def test_pods_are_restricted_and_bounded(workload: dict[str, Any]) -> None:
    """As the restricted pod security standard asks; secrets are named, and none is written down."""
    pod = workload["spec"]["template"]["spec"]
    assert (
        of_kind("Namespace")[0]["metadata"]["labels"]["pod-security.kubernetes.io/enforce"]
        == "restricted"
    )
    assert pod["automountServiceAccountToken"] is False
    assert pod["enableServiceLinks"] is False  # FEWVIEW_PORT would be a URL
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["seccompProfile"]["type"] == "RuntimeDefault"
    assert not {"hostNetwork", "hostPID", "hostIPC"} & set(pod)
    assert all("sizeLimit" in volume["emptyDir"] for volume in pod["volumes"])
    grace = Settings().grace_seconds + 15
    assert pod["terminationGracePeriodSeconds"] >= grace
    for container in pod["containers"]:
        own = container["securityContext"]
        assert own["allowPrivilegeEscalation"] is False
        assert own["readOnlyRootFilesystem"] is True
        assert own["capabilities"]["drop"] == ["ALL"]
        assert "memory" in container["resources"]["limits"]
        given = {each["name"]: each for each in container["env"]}
        for name in ("FEWVIEW_REDIS_URL", "FEWVIEW_DATABASE_URL", "AWS_SECRET_ACCESS_KEY"):
            assert given[name]["valueFrom"]["secretKeyRef"]["name"] == "fewview"
            assert "value" not in given[name]
        known = {
            f"FEWVIEW_{field.upper()}"
            for settings in (Settings, WorkerSettings, StoreSettings)
            for field in settings.model_fields
        }
        configured = of_kind("ConfigMap")[0]["data"]
        assert {name for name in (*given, *configured) if name.startswith("FEWVIEW_")} <= known
    assert not of_kind("Secret")


def test_probes_and_services_ask_for_what_there_is(api: TestClient) -> None:
    paths = api.get("/openapi.json").json()["paths"]
    for workload in of_kind("Deployment"):
        pod = workload["spec"]["template"]
        container = pod["spec"]["containers"][0]
        for probe in ("startupProbe", "livenessProbe"):
            asked = container[probe]
            if "httpGet" in asked:
                assert asked["httpGet"]["path"] in paths
            else:
                assert asked["exec"]["command"] == ["fewview", "health", "worker"]
        if annotations := pod["metadata"].get("annotations"):
            assert annotations["prometheus.io/path"] in paths
    labels = of_kind("Deployment")[0]["spec"]["template"]["metadata"]["labels"]
    selectors = [of_kind("Service")[0]["spec"]["selector"]] + [
        policy["spec"]["podSelector"].get("matchLabels", {}) for policy in of_kind("NetworkPolicy")
    ]
    assert all(selector.items() <= labels.items() for selector in selectors)
    assert any(
        policy["spec"]["podSelector"] == {} and "ingress" not in policy["spec"]
        for policy in of_kind("NetworkPolicy")
    )


def test_workers_are_scaled_by_the_age_of_the_oldest_job() -> None:
    scaled = of_kind("ScaledObject")[0]["spec"]
    assert scaled["scaleTargetRef"]["name"] in {
        each["metadata"]["name"] for each in of_kind("Deployment")
    }
    assert 0 < scaled["minReplicaCount"] < scaled["maxReplicaCount"]
    assert "fewview_oldest_waiting_job_seconds" in scaled["triggers"][0]["metadata"]["query"]


@pytest.fixture(scope="module")
def shown(api: TestClient) -> dict[str, set[str]]:
    """Return the labels of each series that `/metrics` shows."""
    housekeeping.take_turn(api.app.state.store)  # type: ignore[attr-defined]
    api.get("/no/such/path")
    lines = [line for line in api.get("/metrics").text.splitlines() if not line.startswith("#")]
    found: dict[str, set[str]] = {}
    for line in lines:
        name, _, labels = line.rpartition(" ")[0].partition("{")
        found.setdefault(name, set()).update(re.findall(r'(\w+)="', labels))
    return found


def nodes(expression: Any, kind: type) -> list[Any]:
    """Return the parts of a parsed expression that are of one kind."""
    found: list[Any] = []

    def note(node: Any) -> bool:
        if isinstance(node, kind):
            found.append(node)
        return True

    promql_parser.walk(expression, note)
    return found


@cache
def parsed(text: str) -> Any:
    return promql_parser.parse(text.replace("$__rate_interval", "5m"))


def test_rules_and_panels_are_of_metrics_that_there_are(shown: dict[str, set[str]]) -> None:
    queries = [each["spec"]["triggers"][0]["metadata"]["query"] for each in of_kind("ScaledObject")]
    used = set()
    for text in EXPRESSIONS + queries:
        for selector in nodes(parsed(text), promql_parser.VectorSelector):
            used.add(selector.name)
            assert selector.name in shown or selector.name in ITS_OWN, text
            asked = {matcher.name for matcher in selector.matchers.matchers}
            assert asked <= shown.get(selector.name, set()) | ITS_LABELS, text
        for aggregate in nodes(parsed(text), promql_parser.AggregateExpr):
            by = set(aggregate.modifier.labels) if aggregate.modifier is not None else set()
            for selector in nodes(aggregate.expr, promql_parser.VectorSelector):
                assert by <= shown[selector.name] | ITS_LABELS, text
    assert len(used) > 10


def test_alerts_say_what_to_do() -> None:
    assert len({rule["alert"] for rule in RULES}) == len(RULES)
    for rule in RULES:
        assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}
        assert rule["labels"]["severity"] in ("critical", "warning")
        assert set(rule["annotations"]) == {"summary", "description"}
        shown = re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"])
        assert all(
            re.search(rf"\b{label}\b", rule["expr"]) or label == "instance" for label in shown
        )
        if "for" in rule:
            promql_parser.parse_duration(rule["for"])


def test_panels_have_places_of_their_own() -> None:
    panels = DASHBOARD["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    for one, other in combinations([panel["gridPos"] for panel in panels], 2):
        apart = (
            one["x"] + one["w"] <= other["x"]
            or other["x"] + other["w"] <= one["x"]
            or one["y"] + one["h"] <= other["y"]
            or other["y"] + other["h"] <= one["y"]
        )
        assert apart
        assert one["x"] + one["w"] <= 24
    variables = {variable["name"] for variable in DASHBOARD["templating"]["list"]}
    assert set(re.findall(r"\$\{(\w+)\}", json.dumps(DASHBOARD))) <= variables


def test_compose_is_of_its_specification() -> None:
    """With its anchors merged, and variables in the place of which words stand."""
    text = (ROOT / "docker-compose.yml").read_text()
    text = re.sub(r"\$\{(?:FEWVIEW_MEMORY|\w+_IMAGE):-([^}]+)\}", r"\1", text)
    read = PyOptions(apply_merge=True).from_yaml
    compose = read(text)
    compose.validate()
    compose.to_spec()
    for right, wrong in (("pids_limit: 512 #", "pids_limit: many #"), ("cap_drop:", "cap_drops:")):
        assert right in text
        with pytest.raises(ValueError, match=r"\w"):
            read(text.replace(right, wrong)).to_spec()
