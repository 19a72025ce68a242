"""What Prometheus and Grafana are given to watch gateways with, against what a real gateway tells."""

import asyncio
import json
import re
import shutil
import subprocess
from pathlib import Path

import promql_parser
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from robosac.answers import Reason, Source, Verdict
from service.problems import ANSWERS
from tests.service.conftest import serve

ROOT = Path(__file__).parents[2]
PROMETHEUS = ROOT / "deploy" / "prometheus"
RULES = [rule for group in yaml.safe_load((PROMETHEUS / "rules.yml").read_text())["groups"] for rule in group["rules"]]
DASHBOARD = json.loads((ROOT / "deploy" / "grafana" / "robosac.json").read_text())
PANELS = {panel["title"]: [target["expr"] for target in panel["targets"]] for panel in DASHBOARD["panels"]}
OF_PROMETHEUS = {"up", "ALERTS"}
TARGET_LABELS = {"job", "instance", "le", "alertstate"}


def selectors(expression):
    """Of an expression, each metric with its matchers."""
    found = []

    def visit(node):
        if isinstance(node, promql_parser.VectorSelector):
            found.append((node.name, [(one.name, str(one.op), one.value) for one in node.matchers.matchers]))

    promql_parser.walk(promql_parser.parse(expression.replace("$__rate_interval", "5m")), visit)
    assert found, expression
    return found


EXPRESSIONS = {f"alert {rule['alert']}": [rule["expr"]] for rule in RULES} | {
    f"panel {t}": e for t, e in PANELS.items()
}
ANNOTATIONS = [one["expr"] for one in DASHBOARD["annotations"]["list"]]


@pytest.fixture(scope="module")
def exported(ego_message, attacked):
    """Names of samples that a gateway exports, each with its labels."""
    families = list(text_string_to_metric_families(asyncio.run(metrics_of_a_gateway(ego_message, attacked))))
    empty = [family.name for family in families if not family.samples]
    assert not empty  # so that the labels of all are known
    return {sample.name: set(sample.labels) for family in families for sample in family.samples}


async def metrics_of_a_gateway(ego_message, attacked):
    async with serve(latency_budget_ms=20_000) as served:
        session = await served.open(defense={"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3})
        await served.ego(session).post_frame(0, ego_message, attacked)
        cut_short = await served.open(latency_budget_ms=0.01, gather_ms=0)
        await served.ego(cut_short).post_frame(0, ego_message, attacked)
        await served.post(session, "messages", b"", session.teammate_tokens["car-2"])
        return (await served.http.get("/metrics")).text


@pytest.mark.parametrize("where", EXPRESSIONS)
def test_every_metric_and_label_is_one_that_a_gateway_exports(exported, where):
    for expression in EXPRESSIONS[where]:
        for name, matchers in selectors(expression):
            assert name in exported.keys() | OF_PROMETHEUS
            assert {label for label, _, _ in matchers} <= exported.get(name, set()) | TARGET_LABELS
        grouped = re.findall(r"\bby \(([^)]*)\)", expression)
        labels = set().union(*(exported.get(name, set()) for name, _ in selectors(expression)))
        assert {label.strip() for group in grouped for label in group.split(",")} <= labels | TARGET_LABELS


def test_every_metric_of_the_gateway_is_on_the_dashboard_or_has_an_alert(exported):
    expressions = [expression for several in EXPRESSIONS.values() for expression in several]
    used = {re.sub("_(bucket|count|sum)$", "", name) for one in expressions for name, _ in selectors(one)}
    own = {re.sub("_(bucket|count|sum|created)$", "", name) for name in exported if name.startswith("robosac_")}
    assert {name for name in own if f"{name}_total" not in own} <= used
    runbook = (ROOT / "docs" / "runbook.md").read_text()
    assert not [name for name in own if f"`{name}`" not in runbook and f"`{name}_total`" not in runbook]


@pytest.mark.parametrize("where", EXPRESSIONS)
def test_every_value_that_is_asked_for_can_be(where):
    known = {
        "type": {kind.value for kind in ANSWERS},
        "source": {source.value for source in Source},
        "reason": {reason.value for reason in Reason},
        "verdict": {verdict.value for verdict in Verdict},
        "by": {"deadline", "fault"},
        "stage": {"receive", "gather", "queue", "store", "total"},
        "job": {"robosac"},
    }
    for expression in EXPRESSIONS[where]:
        for name, matchers in selectors(expression):
            for label, _, value in matchers:
                assert label == "instance" or set(value.split("|")) <= known[label], f"{name}: {label}"


def test_annotations_of_the_dashboard_can_be_read():
    assert {name for one in ANNOTATIONS for name, _ in selectors(one)} <= OF_PROMETHEUS


def test_every_alert_has_a_reason_and_its_place_in_the_runbook():
    headings = re.findall(r"^## (.+)$", (ROOT / "docs" / "runbook.md").read_text(), re.MULTILINE)
    anchors = {heading.lower().replace(" ", "-") for heading in headings}
    for rule in RULES:
        told = rule["annotations"]
        page, _, anchor = told["runbook"].partition("#")
        assert page == "docs/runbook.md"
        assert anchor in anchors, rule["alert"]
        assert len(told["reason"]) > 30
        assert rule["labels"]["severity"] in ("warning", "critical")
    text = (ROOT / "docs" / "runbook.md").read_text()
    assert not [rule["alert"] for rule in RULES if f"`{rule['alert']}`" not in text]


def test_panels_fit_beside_each_other():
    taken = set()
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        cells = {(place["x"] + x, place["y"] + y) for x in range(place["w"]) for y in range(place["h"])}
        assert not cells & taken
        assert place["x"] + place["w"] <= 24
        assert panel["description"]
        taken |= cells
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed (Debian's prometheus)")
@pytest.mark.parametrize("check", [("check", "config", "prometheus.yml"), ("test", "rules", "rules_test.yml")])
def test_promtool_takes_the_configuration_and_the_rules_do_as_they_say(check):
    done = subprocess.run(["promtool", *check], check=False, cwd=PROMETHEUS, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_rules_are_tested_one_and_all():
    (loud,) = [
        check["exp_samples"]
        for case in yaml.safe_load((PROMETHEUS / "rules_test.yml").read_text())["tests"]
        for check in case["promql_expr_test"]
        if check["exp_samples"]
    ]
    assert {re.search('"(.*)"', one["labels"])[1] for one in loud} == {rule["alert"] for rule in RULES}
