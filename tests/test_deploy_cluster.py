"""What `deploy/` has for clusters, as far as it can be checked without one: schemas, what refers to what, real parsers,
the batch script with programs that only say how they were called."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from bench.processes import free_ports
from tests.clips import write_panned
from tests.server.page.metric_names import metric_names
from tests.stream.conftest import SMALL_FLAGS
from tests.trainer.training import configured, losses, trained
from tests.waiting import until
from trainer.run.reporting import METRICS_FILE
from v2v_client.local_server import LocalServer
from v2v_server.commands import serve as serve_command
from v2v_server.commands import worker as worker_command
from v2v_server.config import ServeConfig

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
KUBERNETES = DEPLOY / "kubernetes"
KUBERNETES_VERSION = "1.30"
BATCH = DEPLOY / "slurm" / "train.sbatch"
NODES_BATCH = DEPLOY / "slurm" / "nodes.sbatch"
GPU_FIRST = DEPLOY.parent / "examples" / "gpu_first.sh"


@cache
def documents() -> list[dict[str, Any]]:
    """Of all files that the kustomization names."""
    names = yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())["resources"]
    return [document for name in names for document in yaml.safe_load_all((KUBERNETES / name).read_text())]


def named(kind: str, name: str) -> dict[str, Any]:
    (found,) = [each for each in documents() if (each["kind"], each["metadata"]["name"]) == (kind, name)]
    return found


def pod(name: str) -> dict[str, Any]:
    """Return the template of the pods of a set or a deployment."""
    template: dict[str, Any] = named("StatefulSet" if name == "v2v-broker" else "Deployment", name)["spec"]["template"]
    return template


def container(name: str) -> dict[str, Any]:
    """Return the container of such a pod, with the values of the kustomization in its arguments."""
    (found,) = pod(name)["spec"]["containers"]
    assert found["envFrom"] == [{"configMapRef": {"name": "v2v-values"}}]
    return {**found, "args": filled(found["args"])}


def filled(arguments: list[str]) -> list[str]:
    """Put the values of the kustomization into arguments, as Kubernetes does."""
    return [re.sub(r"\$\((\w+)\)", lambda match: values()[match[1]], each) for each in arguments]


def values() -> dict[str, str]:
    (generated,) = yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())["configMapGenerator"]
    return dict(each.split("=", 1) for each in generated["literals"])


# --- Kubernetes -------------------------------------------------------------------------------------------------------


def test_every_manifest_is_listed_and_matches_its_schema() -> None:
    validate = pytest.importorskip("kubernetes_validate")
    assert {path.name for path in KUBERNETES.glob("*.yaml")} == {
        "kustomization.yaml", *yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())["resources"],
    }  # fmt: skip
    for document in documents():
        validate.validate(document, KUBERNETES_VERSION, strict=True)
    with pytest.raises(validate.ValidationError):
        validate.validate(documents()[1] | {"specification": {}}, KUBERNETES_VERSION, strict=True)


def build(components: list[str], folder: Path) -> list[dict[str, Any]]:
    """Return what kustomize makes of the manifests with these components."""
    shutil.copytree(KUBERNETES, folder)
    file = folder / "kustomization.yaml"
    file.write_text(file.read_text() + yaml.safe_dump({"components": components}))
    built = subprocess.run(["kubectl", "kustomize", folder], capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return list(yaml.safe_load_all(built.stdout))


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl is not here")
@pytest.mark.parametrize("component", [[], ["autoscale"]])
def test_the_kustomization_builds(component: list[str], tmp_path: Path) -> None:
    made = build(component, tmp_path / "k")
    assert len(made) == len(documents()) + len(component) + 1  # the values
    assert {each["metadata"].get("namespace", "v2v") for each in made} == {"v2v"}
    images = {
        each["spec"]["template"]["spec"]["containers"][0]["image"]
        for each in made
        if "template" in each.get("spec", {})
    }
    assert images == {"registry.example/v2v-server:1"}
    counts = {each["metadata"]["name"]: each["spec"]["replicas"] for each in made if "replicas" in each.get("spec", {})}
    assert counts == {"v2v-broker": len(values()["BROKERS"].split(",")), "v2v-workers": 8}
    maps = {each["metadata"]["name"]: each["data"] for each in made if each["kind"] == "ConfigMap"}
    (name,) = maps
    assert maps[name] == values()
    for each in made:
        if "template" in each.get("spec", {}):
            (main,) = each["spec"]["template"]["spec"]["containers"]
            assert main["envFrom"] == [{"configMapRef": {"name": name}}]


def test_every_pod_selector_matches_pods() -> None:
    pods = []
    for each in documents():
        if each["kind"] in ("Deployment", "StatefulSet"):
            pods.append(each["spec"]["template"]["metadata"]["labels"])
            assert each["spec"]["selector"]["matchLabels"] == pods[-1]
    for each in documents():
        spec = each.get("spec", {})
        selector = spec.get("selector" if each["kind"] != "NetworkPolicy" else "podSelector")
        if selector is not None:
            assert selector.get("matchLabels", selector) in pods, each["metadata"]["name"]
    scaled = yaml.safe_load((KUBERNETES / "autoscale" / "scaled-object.yaml").read_text())["spec"]
    named("Deployment", scaled["scaleTargetRef"]["name"])
    assert scaled["minReplicaCount"] < scaled["maxReplicaCount"] <= serving().expect_workers


def serving() -> ServeConfig:
    """What the broker's pod is told, as the program itself understands it."""
    asked: list[ServeConfig] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("v2v_server.serve.serve", lambda config, *_: asked.append(config))
        assert serve_command.main(container("v2v-broker")["args"]) == 0
    return asked[0]


def test_ports_of_the_broker_match_workers_trainers_probes_and_policies() -> None:
    main, config = container("v2v-broker"), serving()
    assert main["command"] == ["v2v-serve"]
    ports = {port["name"]: port["port"] for port in named("Service", "v2v-broker")["spec"]["ports"]}
    assert ports == {port["name"]: port["containerPort"] for port in main["ports"]}
    assert config.bind.endswith(f":{ports['consumers']}")
    assert config.worker_bind.endswith(f":{ports['workers']}")
    assert config.most_workers == 0
    for probe in ("startupProbe", "readinessProbe"):
        assert main[probe]["exec"]["command"] == ["test", "-s", config.port_file]
    assert main["livenessProbe"]["tcpSocket"]["port"] in ports
    policy = named("NetworkPolicy", "v2v-broker")["spec"]["ingress"]
    assert [rule["ports"][0]["port"] for rule in policy] == [ports["consumers"], ports["workers"], ports["page"]]
    assert (config.page, config.page_host) == (ports["page"], "0.0.0.0")
    annotations = pod("v2v-broker")["metadata"]["annotations"]
    assert annotations["prometheus.io/port"] == str(ports["page"])
    assert policy[1]["from"][0]["podSelector"] == named("NetworkPolicy", "v2v-workers")["spec"]["podSelector"]


def working(arguments: list[str]) -> list[Any]:
    """What a worker is told, as the program itself understands it."""
    asked: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker_command, "open_source", lambda name, _: SimpleNamespace(name=name, copies=None))
        patch.setattr(worker_command, "run_worker", lambda *understood, **_: asked.extend(understood))
        assert worker_command.main(arguments) == 0
    return asked


def test_workers_connect_to_each_broker_and_have_its_videos(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_command, "make_cache", lambda folder: None)
    main = container("v2v-workers")
    assert main["command"] == ["v2v-worker"]
    service = named("StatefulSet", "v2v-broker")["spec"]["serviceName"]
    port = named("Service", service)["spec"]["ports"][1]["port"]
    brokers, source, *_ = working(main["args"])
    assert brokers == tuple(f"tcp://v2v-broker-{number}.{service}:{port}" for number in range(2))
    assert source.name == serving().videos


@pytest.mark.parametrize("deployment", ["v2v-broker", "v2v-workers"])
def test_mounted_volumes_exist(deployment: str) -> None:
    spec = pod(deployment)["spec"]
    mounts = {mount["name"]: mount["mountPath"] for mount in container(deployment)["volumeMounts"]}
    claims = named("StatefulSet", deployment)["spec"]["volumeClaimTemplates"] if deployment == "v2v-broker" else []
    assert set(mounts) == {volume["name"] for volume in spec["volumes"]} | {each["metadata"]["name"] for each in claims}
    cache = "state" if deployment == "v2v-broker" else "cache"
    assert f"ENV V2V_CACHE_DIR={mounts[cache]}\n" in (DEPLOY / "Dockerfile").read_text()
    assert f"--uid {spec['securityContext']['runAsUser']} " in (DEPLOY / "Dockerfile").read_text()


def test_the_scaler_queries_existing_metrics() -> None:
    query = yaml.safe_load((KUBERNETES / "autoscale" / "scaled-object.yaml").read_text())["spec"]["triggers"][0]
    assert "v2v_waiting_share{" in query["metadata"]["query"]
    assert "v2v_waiting_share" in metric_names()


# --- systemd, shell ---------------------------------------------------------------------------------------------------


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not here")
def test_systemd_accepts_the_units(tmp_path: Path) -> None:
    for unit in (DEPLOY / "systemd").glob("*.service"):
        text = "".join(
            "ExecStart=/bin/sh\n" if line.startswith("ExecStart=") else line
            for line in unit.read_text().splitlines(True)
        )
        file = tmp_path / unit.name.replace("@.", "@1.")
        file.write_text(text)
        done = subprocess.run(["systemd-analyze", "verify", file], capture_output=True, text=True, check=False)
        assert (done.returncode, [line for line in done.stderr.splitlines() if unit.stem in line]) == (0, [])


@pytest.mark.parametrize("deployment", ["v2v-broker", "v2v-workers"])
def test_a_pod_has_minimal_rights(deployment: str) -> None:
    spec = pod(deployment)["spec"]
    assert spec["automountServiceAccountToken"] is False
    assert spec["securityContext"]["runAsNonRoot"] is True
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert container(deployment)["securityContext"] == {
        "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
    }  # fmt: skip


def test_the_workers_unit_runs_a_valid_command() -> None:
    (line,) = [
        line.removeprefix("ExecStart=")
        for line in (DEPLOY / "systemd" / "v2v-worker@.service").read_text().splitlines()
        if line.startswith("ExecStart=")
    ]
    program, *arguments = shlex.split(line)
    assert program.endswith("/v2v-worker")
    assert working(arguments)


def test_shellcheck_finds_nothing() -> None:
    shellcheck = Path(sys.executable).with_name("shellcheck")
    if not shellcheck.exists():
        pytest.skip("shellcheck is not installed")
    done = subprocess.run([shellcheck, BATCH, NODES_BATCH, GPU_FIRST], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


# --- Slurm ------------------------------------------------------------------------------------------------------------

SAYS = 'echo "$(basename "$0") $*" >> "$LOG"\n'
PROGRAMS = {
    "v2v-serve": SAYS
    + 'while [ $# -gt 0 ]; do [ "$1" = --port-file ] && echo tcp://127.0.0.1:7 > "$2"; shift; done\n'
    + "exec sleep 600\n",
    "srun": SAYS + 'while [ "${1#--}" != "$1" ]; do shift; done\nexec "$@"\n',
    "v2v-worker": SAYS + "exec sleep 600\n",
    "v2v-train": SAYS
    + 'save() { echo saving >> "$LOG"; until [ -e "$OUT/may-save" ]; do sleep 0.05; done\n'
    + 'touch "$OUT/last.pt"; echo saved >> "$LOG"; exit 143; }\n'
    + "trap save TERM\n$TRAINING\n",
    "scontrol": SAYS + 'kill -TERM "$PPID"\n',  # as Slurm ends a job that it requeues
}


def start_batch(folder: Path, training: str) -> subprocess.Popen[bytes]:
    """The batch script among programs that only say how they were called."""
    programs = folder / "bin"
    programs.mkdir(exist_ok=True)
    for name, text in PROGRAMS.items():
        (programs / name).write_text(f"#!/bin/bash\n{text.replace('$TRAINING', training)}")
        (programs / name).chmod(0o755)
    given = {
        "PATH": f"{programs}:{os.environ['PATH']}", "LOG": str(folder / "log"), "OUT": str(folder),
        "VIDEOS": "/data/my videos", "SLURM_NTASKS_HET_GROUP_1": "128", "SLURM_JOB_ID": "1234567",
    }  # fmt: skip
    return subprocess.Popen(["bash", BATCH], env=os.environ | given, start_new_session=True)


def said(folder: Path) -> list[str]:
    return (folder / "log").read_text().splitlines() if (folder / "log").exists() else []


def test_the_batch_job_starts_all_three_and_leaves_nothing(tmp_path: Path) -> None:
    job = start_batch(tmp_path, 'until grep -q "^v2v-worker" "$LOG"; do sleep 0.05; done; exit 0')
    assert job.wait(timeout=60) == 0
    serve, *others = said(tmp_path)
    port = 20000 + 1234567 % 20000
    assert "--expect-workers 128 " in serve
    assert f"--worker-bind tcp://0.0.0.0:{port} " in serve
    assert any(line.startswith("srun --het-group=1 ") for line in others)
    assert f"v2v-train e2vid --connect tcp://127.0.0.1:7 --out {tmp_path}" in others
    until(lambda: _is_empty(job.pid))


def _is_empty(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.slow
def test_a_batch_job_that_is_terminated_twice_saves_before_it_is_requeued_and_continues(tmp_path: Path) -> None:
    job = start_batch(tmp_path, "while true; do sleep 0.1; done")
    until(lambda: any(line.startswith("v2v-train") for line in said(tmp_path)))
    until(lambda: any(line.startswith("v2v-worker") for line in said(tmp_path)))
    job.send_signal(signal.SIGTERM)
    until(lambda: "saving" in said(tmp_path))
    job.send_signal(signal.SIGTERM)
    (tmp_path / "may-save").touch()
    assert job.wait(timeout=60) == 143
    assert said(tmp_path)[-2:] == ["saved", "scontrol requeue 1234567"]
    assert start_batch(tmp_path, "exit 0").wait(timeout=60) == 0
    assert any(f"--out {tmp_path} --resume {tmp_path}/last.pt" in line for line in said(tmp_path))


# --- several nodes: one host stands for all of them, so this says nothing of Slurm itself -----------------------------

NODES = {
    # A task a node, as srun starts them; it passes on what ends it, and ends like the worst of them.
    "srun": """\
while [ "${1#--}" != "$1" ]; do shift; done
tasks=()
for node in $(seq 0 $((SLURM_NNODES - 1))); do SLURM_NODEID=$node "$@" & tasks+=($!); done
trap 'kill -TERM "${tasks[@]}"; interrupted=yes' TERM
worst=0
for task in "${tasks[@]}"; do
    while :; do
        interrupted="" status=0
        wait "$task" || status=$?
        [ -n "$interrupted" ] || break
    done
    [ $status -le $worst ] || worst=$status
done
exit $worst
""",
    "hostname": "echo 127.0.0.1\n",
    "scontrol": SAYS,
}


def start_nodes(
    folder: Path, nodes: int, gpus: int, *arguments: str, programs: dict[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Start the script for several nodes, all of them on this host."""
    stubs = folder / "nodes"
    stubs.mkdir(exist_ok=True)
    for name, text in (NODES | (programs or {})).items():
        (stubs / name).write_text(f"#!/bin/bash\n{text}")
        (stubs / name).chmod(0o755)
    given = {
        "PATH": f"{stubs}:{Path(sys.executable).parent}:{os.environ['PATH']}", "LOG": str(folder / "log"),
        "SLURM_NNODES": str(nodes), "SLURM_GPUS_ON_NODE": str(gpus), "SLURM_CPUS_ON_NODE": str(3 * gpus),
        "SLURM_JOB_ID": str(free_ports(1)[0] - 20000), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1",
        "OUT": str(folder / "run"), "VIDEOS": str(folder / "clips"), "V2V_CACHE_DIR": str(folder / "cache"),
        "SERVE_FLAGS": " ".join(SMALL_FLAGS),
    }  # fmt: skip
    with (folder / "output").open("ab") as output:
        command = ["bash", NODES_BATCH, *arguments]
        return subprocess.Popen(
            command, env=os.environ | given, start_new_session=True, stdout=output, stderr=subprocess.STDOUT
        )


def test_each_node_has_a_server_and_a_rank_for_each_gpu(tmp_path: Path) -> None:
    serve = PROGRAMS["v2v-serve"]
    job = start_nodes(tmp_path, 2, 8, "eraft", "--set", "x=1", programs={"v2v-serve": serve, "torchrun": SAYS})
    assert job.wait(timeout=60) == 0
    lines = said(tmp_path)
    assert sum(line.startswith("v2v-serve ") and "--workers 8 " in line for line in lines) == 2
    for node in (0, 1):
        start = f"torchrun --nnodes 2 --nproc-per-node 8 --node-rank {node} --master-addr 127.0.0.1 --master-port "
        (line,) = [each for each in lines if each.startswith(start)]
        end = f" -m trainer.train eraft --set x=1 --connect tcp://127.0.0.1:7 --out {tmp_path}/run"
        assert line.endswith(end)
    until(lambda: _is_empty(job.pid))


@pytest.mark.slow
def test_two_nodes_of_two_ranks_are_ended_and_continued_on_one_with_the_samples_of_one_rank(tmp_path: Path) -> None:
    """Gloo, and a server for each node."""
    write_panned(tmp_path / "clips", 4, 61, 48, 64)
    config = configured(tmp_path)
    common = (config, "--set", "run.steps=12")
    with LocalServer(tmp_path / "clips", workers=1, flags=SMALL_FLAGS) as server:
        alone = trained(tmp_path, server.address, "alone", run__steps=12)
    job = start_nodes(tmp_path, 2, 2, *common, "--set", "stream.batch_size=1", "--set", "run.save_every=1")
    metrics = tmp_path / "run" / METRICS_FILE
    until(lambda: job.poll() is not None or (metrics.exists() and len(losses(tmp_path / "run")) >= 2))
    job.terminate()  # as Slurm does before the time is up
    job.wait(timeout=240)
    output = tmp_path / "output"
    assert [line.rpartition(" ")[0] for line in said(tmp_path)] == ["scontrol requeue"], output.read_text()
    assert 2 <= len(losses(tmp_path / "run")) < 12, output.read_text()
    job = start_nodes(tmp_path, 1, 2, *common, "--set", "stream.batch_size=2")
    assert job.wait(timeout=240) == 0, output.read_text()
    ours, theirs = losses(tmp_path / "run"), losses(alone)
    assert [record["step"] for record in ours] == list(range(1, 13))
    for mine, one in zip(ours, theirs, strict=True):
        assert mine["total"] == pytest.approx(one["total"], rel=1e-4)
        assert mine["epoch"] == one["epoch"]
