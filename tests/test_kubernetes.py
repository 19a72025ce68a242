"""The manifests for Kubernetes, against its own schemas; no cluster is needed."""

import re
from pathlib import Path
from pkgutil import resolve_name

import kubernetes_validate
import pytest
import yaml

from service.settings import Settings

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "deploy" / "kubernetes"
ALL = [(path.name, each) for path in sorted(FOLDER.glob("*.yaml")) for each in yaml.safe_load_all(path.read_text())]
OBJECTS = [
    (file, each) for file, each in ALL if not each["apiVersion"].startswith("ray.io/")
]  # they have no schema here
(RAY,) = [each for _, each in ALL if each["kind"] == "RayService"]
PODS = [each["spec"] for _, each in OBJECTS if each["kind"] in ("Deployment", "StatefulSet")]


@pytest.mark.parametrize("version", ["1.30", "1.37"])
@pytest.mark.parametrize(("file", "each"), OBJECTS, ids=[f"{file}-{each['kind']}" for file, each in OBJECTS])
def test_objects_are_what_kubernetes_takes(file, each, version):
    kubernetes_validate.validate(each, version, strict=True)


def test_a_wrong_field_is_found():
    (_, service), *_ = OBJECTS
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate({**service, "spec": {**service["spec"], "port": 8000}}, "1.37", strict=True)


@pytest.mark.parametrize("spec", PODS)
def test_pods_may_do_no_more_than_a_gateway_has_to(spec):
    pod = spec["template"]["spec"]
    (container,) = pod["containers"]
    assert pod["automountServiceAccountToken"] is False
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["runAsUser"] == int(re.search(r"--uid (\d+)", dockerfile())[1])
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    settings = Settings()
    memory = int(container["resources"]["limits"]["memory"].removesuffix("Gi")) * 2**30
    assert memory >= settings.max_inflight_bytes + settings.max_pending_bytes + 2**30


@pytest.mark.parametrize("spec", PODS)
def test_pods_have_the_settings_ports_and_volumes_that_they_name(spec):
    assert spec["selector"]["matchLabels"].items() <= spec["template"]["metadata"]["labels"].items()
    pod = spec["template"]["spec"]
    (container,) = pod["containers"]
    for variable in container["env"]:
        assert variable["name"].removeprefix("ROBOSAC_").lower() in Settings.model_fields
    (port,) = container["ports"]
    assert str(port["containerPort"]) in re.search(r"EXPOSE (.*)", dockerfile())[1].split()
    probes = [container[kind]["httpGet"] for kind in ("startupProbe", "livenessProbe", "readinessProbe")]
    assert [probe["path"] for probe in probes] == ["/healthz", "/healthz", "/readyz"]
    assert {probe["port"] for probe in probes} == {port["name"]}
    claims = {claim["metadata"]["name"] for claim in spec.get("volumeClaimTemplates", ())}
    volumes = {volume["name"] for volume in pod["volumes"]}
    assert {mount["name"] for mount in container["volumeMounts"]} == volumes | claims


def test_only_a_gateway_with_a_file_of_its_own_keeps_sessions_in_a_file():
    for spec in PODS:
        (container,) = spec["template"]["spec"]["containers"]
        (url,) = [one for one in container["env"] if one["name"] == "ROBOSAC_DATABASE_URL"]
        if "volumeClaimTemplates" in spec:
            assert spec["replicas"] == 1
            folder = Path(url["value"].removeprefix("sqlite:///")).parent
            assert str(folder) in {mount["mountPath"] for mount in container["volumeMounts"]}
        else:
            assert url["valueFrom"]["secretKeyRef"] == {"name": "robosac", "key": "database-url"}


def test_services_lead_to_pods():
    labels = [spec["template"]["metadata"]["labels"] for spec in PODS]
    for _, each in OBJECTS:
        if each["kind"] == "Service":
            assert any(each["spec"]["selector"].items() <= pod.items() for pod in labels)


def groups():
    cluster = RAY["spec"]["rayClusterConfig"]
    return [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]


@pytest.mark.parametrize("group", groups(), ids=lambda group: group.get("groupName", "head"))
def test_pods_of_ray_are_what_kubernetes_takes_and_may_do_little(group):
    labels = group["template"]["metadata"]["labels"]
    pod = {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {"name": "x", "labels": labels},
        "spec": group["template"]["spec"],
    }
    kubernetes_validate.validate(pod, "1.37", strict=True)
    assert pod["spec"]["securityContext"]["runAsNonRoot"] is True
    (container,) = pod["spec"]["containers"]
    assert container["securityContext"] == {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
    assert {one["name"].removeprefix("ROBOSAC_").lower() for one in container["env"]} <= set(Settings.model_fields)
    mounts = {mount["name"] for mount in container["volumeMounts"]}
    assert mounts == {volume["name"] for volume in pod["spec"]["volumes"]}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Ray's own
def test_ray_serve_takes_the_configuration_of_the_service():
    pytest.importorskip("ray", reason="Ray is not installed (robosac[cluster])")
    from ray.serve._private.api import call_user_app_builder_with_args_if_necessary
    from ray.serve.schema import ServeDeploySchema

    config = ServeDeploySchema.model_validate(yaml.safe_load(RAY["spec"]["serveConfigV2"]))
    (application,) = config.applications
    built = call_user_app_builder_with_args_if_necessary(resolve_name(application.import_path), application.args)
    scaling = built._bound_deployment._deployment_config.autoscaling_config
    assert (scaling.min_replicas, scaling.max_replicas) == (application.args["least"], application.args["most"])


def test_the_service_runs_the_version_of_ray_that_is_tested():
    (tested,) = re.findall(r"^ray==(.*)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert RAY["spec"]["rayClusterConfig"]["rayVersion"] == tested


def dockerfile():
    return (ROOT / "docker" / "Dockerfile").read_text()
