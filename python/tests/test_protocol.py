"""The package speaks the protocol of this repository."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from conftest import ROOT

from isodream.security import ROLES
from isodream.service import PROTOCOL_VERSION


def test_the_generated_module_is_that_of_the_protocol(tmp_path: Path) -> None:
    def generate(target: Path) -> list[str]:
        outputs = [f"--python_out={target}", f"--pyi_out={target}"]
        return [sys.executable, "-m", "grpc_tools.protoc", "-Iproto", *outputs, "isodream/v1/environment.proto"]

    subprocess.run(generate(tmp_path), cwd=ROOT, check=True)
    for name in ("environment_pb2.py", "environment_pb2.pyi"):
        fresh, ours = tmp_path / "isodream/v1" / name, ROOT / "python/src/isodream/v1" / name
        cure = " ".join([".native/python/bin/python", *generate(Path("python/src"))[1:]])
        assert ours.read_bytes() == fresh.read_bytes(), f"{name} is of another protocol; make it anew: {cure}"


def test_versions_and_roles_are_those_of_the_binary() -> None:
    source = (ROOT / "crates/proto/src/convert.rs").read_text()
    assert re.findall(r"PROTOCOL_VERSION: u32 = (\d+);", source) == [str(PROTOCOL_VERSION)]
    source = (ROOT / "crates/rpc/src/security/tokens.rs").read_text()
    assert re.findall(r'Self::\w+ => "(\w+)",', source) == list(ROLES)
    cargo, python = (re.search(r'^version = "(.+)"$', (ROOT / path).read_text(), re.M) for path in MANIFESTS)
    assert cargo
    assert python
    assert cargo[1] == python[1]


MANIFESTS = ("Cargo.toml", "python/pyproject.toml")
