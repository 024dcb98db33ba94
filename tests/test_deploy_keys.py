"""Test the component "keys": the output of kustomize, and that a server and a worker accept the files in its pods."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.test_deploy_cluster import KUBERNETES, KUBERNETES_VERSION, build, filled
from v2v_protocol.errors import KeyRefused
from v2v_protocol.keys import read_key
from v2v_server.commands import serve as serve_command
from v2v_server.commands.keys import main as keys_command
from v2v_server.config import ServeConfig
from v2v_server.keys import KeyFolder

COMPONENT = KUBERNETES / "keys"
NOTES = [line.removeprefix("#").strip() for line in (COMPONENT / "kustomization.yaml").read_text().splitlines()]


def patch_of(name: str) -> dict[str, Any]:
    """Return the pod that a patch of the component describes."""
    spec: dict[str, Any] = yaml.safe_load((COMPONENT / name).read_text())["spec"]["template"]["spec"]
    return spec


def secrets() -> dict[str, str]:
    """Return the files from which the documented secrets are created, by name."""
    lines = [re.fullmatch(r"kubectl -n v2v create secret generic (\S+) --from-file=(\S+)", line) for line in NOTES]
    return {found[1]: found[2] for found in lines if found}


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl is not here")
@pytest.mark.parametrize("components", [["keys"], ["keys", "autoscale"]])
def test_with_keys_the_manifests_build_and_the_broker_requires_them(
    components: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    validate = pytest.importorskip("kubernetes_validate")
    made = {(each["kind"], each["metadata"]["name"]): each for each in build(components, tmp_path / "k")}
    for kind, document in made.items():
        if kind[0] != "ScaledObject":
            validate.validate(document, KUBERNETES_VERSION, strict=True)
    asked: list[ServeConfig] = []
    monkeypatch.setattr("v2v_server.serve.serve", lambda config, *_: asked.append(config))
    of_broker = made["StatefulSet", "v2v-broker"]["spec"]
    pods = {
        "v2v-broker": of_broker["template"]["spec"],
        "v2v-workers": made["Deployment", "v2v-workers"]["spec"]["template"]["spec"],
    }
    claims = {each["metadata"]["name"] for each in of_broker["volumeClaimTemplates"]}
    keys = KeyFolder(tmp_path / "keys")
    keys.init()
    arguments = pods["v2v-broker"]["containers"][0]["args"]
    assert "--keys=/keys" in arguments
    here = [argument.replace("=/keys", f"={keys.path}") for argument in filled(arguments)]
    assert serve_command.main(here) == 0
    assert (asked[0].keys, asked[0].page_host) == (str(keys.path), "0.0.0.0")
    named = set()
    for spec in pods.values():
        volumes = {volume["name"]: volume for volume in spec["volumes"]}
        for each in [*spec["containers"], *spec["initContainers"]]:
            assert each["image"] == "registry.example/v2v-server:1"
            assert {mount["name"] for mount in each["volumeMounts"]} <= set(volumes) | claims
            assert each["securityContext"]["capabilities"] == {"drop": ["ALL"]}
        named |= {volume["secret"]["secretName"] for volume in volumes.values() if "secret" in volume}
    assert named == set(secrets()) - {"v2v-consumer-key"}


def mounted(folder: Path, files: dict[str, bytes]) -> Path:
    """Create a folder as Kubernetes mounts a secret for the group of a pod: links to links, readable by the group."""
    data = folder / "..2026_11_24"
    data.mkdir(parents=True)
    for name, content in files.items():
        (data / name).write_bytes(content)
        (data / name).chmod(0o440)
        (folder / name).symlink_to(f"..data/{name}")
    (folder / "..data").symlink_to(data.name)
    return folder


def test_a_server_and_a_worker_use_the_keys_in_their_pods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for line in NOTES:
        if line.startswith("v2v-keys "):
            assert keys_command(shlex.split(line)[1:]) == 0
    found: dict[str, dict[str, bytes]] = {}
    for name, source in secrets().items():
        path = Path(source)
        found[name] = {each.name: each.read_bytes() for each in (path.iterdir() if path.is_dir() else [path])}
    for patch, key in ("broker.yaml", "server.key"), ("workers.yaml", "worker.key"):
        pod, place = patch_of(patch), tmp_path / patch.removesuffix(".yaml")
        by_volume = {each["name"]: each["secret"]["secretName"] for each in pod["volumes"] if "secret" in each}
        (init,), (main,) = pod["initContainers"], pod["containers"]
        for mount in [*init["volumeMounts"], *main["volumeMounts"]]:
            where = place / mount["mountPath"].removeprefix("/")
            if mount["name"] in by_volume:
                mounted(where, found[by_volume[mount["name"]]])
            else:
                where.mkdir(parents=True, exist_ok=True)
        with pytest.raises(KeyRefused, match="other users may have read it"):  # why there is a copy
            read_key(place / "secret" / key)
        here = [str(place / part.removeprefix("/")) if part.startswith("/") else part for part in init["command"]]
        subprocess.run(here, check=True)
    keys = KeyFolder(tmp_path / "broker" / "keys")
    public, _ = keys.server_keys()
    assert {side: sorted(names.values()) for side, names in keys.allowed().items()} == {
        "consumer": ["trainer"], "worker": ["cluster"],
    }  # fmt: skip
    (variable,) = patch_of("workers.yaml")["containers"][0]["env"]
    assert variable["name"] == "V2V_KEYS"
    worker = read_key(tmp_path / "workers" / variable["value"].removeprefix("/"))
    assert (worker.side, worker.server) == ("worker", public.decode())
    assert keys.allowed()["worker"][worker.public] == "cluster"
