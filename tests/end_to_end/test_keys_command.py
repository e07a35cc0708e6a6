"""`bricktrack keys` against units with keys: installed by SSH (a stand-in that runs the command here), rotated."""

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bricktrack_common.errors import UnitError, UnitTimeoutError
from bricktrack_common.key_files import make_key_pair, read_public_key, read_secret_key
from bricktrack_common.wire_messages import HelloReply, Request
from bricktrack_device.network.file_server import Answer, FileServer
from bricktrack_device.network.key_folder import create_unit_key
from bricktrack_device.network.unit_keys import UnitKeys
from bricktrack_host.cli.main import app
from bricktrack_host.transfer.fleet_config import load_fleet
from bricktrack_host.transfer.unit_client import UnitClient

SSH = """#!/bin/sh
# ssh -o OPTION -- TARGET COMMAND: does on this machine what the other one would do.
[ "$1" = -o ] && [ "$3" = -- ] || exit 99
case "$4" in *@offline) echo "ssh: no route to host" >&2; exit 255 ;; esac
echo "$4" >> "$SSH_LOG"
exec sh -c "$5"
"""


class Handler:
    is_busy = False

    def __init__(self, name: str) -> None:
        self.name = name

    def handle(self, request: Request, answer: Answer) -> None:
        answer(HelloReply(unit=self.name, software="test", simulated=True), None)


class Laboratory:
    """A fleet file, one unit with a folder of keys and a server, and a host."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.unit_keys = folder / "unit-keys"
        create_unit_key(self.unit_keys)
        self.server = FileServer("127.0.0.1", 0, Handler("b1"), keys=UnitKeys(self.unit_keys))
        self.server.start()
        self.fleet = folder / "fleet.toml"
        self.write_fleet("")

    def write_fleet(self, more: str) -> None:
        self.fleet.write_text(
            '# The laboratory.\n[host]\nsecret_key = "host.key_secret"  # ours\n\n'
            f'[[unit]]\nname = "b1"  # first\naddress = "tcp://127.0.0.1:{self.server.port}"\n{more}\n'
            "# the end\n"
        )

    def bricktrack(self, *arguments: str) -> tuple[int, str, str]:
        done = CliRunner().invoke(app, ["keys", *arguments, "--fleet", str(self.fleet)])
        return done.exit_code, done.stdout, done.stderr

    def by_ssh(self, *arguments: str) -> tuple[int, str, str]:
        remote = f"{sys.executable} -m bricktrack_device.cli"
        return self.bricktrack(
            *arguments, "--ssh", "pi", "--remote", remote, "--remote-folder", str(self.unit_keys)
        )

    def hello(self, key_file: str = "host.key_secret") -> str:
        own = read_secret_key(self.folder / key_file)
        server_key = load_fleet(self.fleet).unit[0].server_key
        with UnitClient(
            f"tcp://127.0.0.1:{self.server.port}", server_key=server_key, own_keys=own, timeout_s=3
        ) as client:
            return client.hello().unit


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Laboratory]:
    ssh = tmp_path / "bin" / "ssh"
    ssh.parent.mkdir()
    ssh.write_text(SSH)
    ssh.chmod(0o755)
    monkeypatch.setenv("PATH", f"{ssh.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("SSH_LOG", str(tmp_path / "ssh.log"))
    made = Laboratory(tmp_path)
    yield made
    made.server.stop()


def test_keys_are_made_installed_and_used(lab: Laboratory) -> None:
    status, public, words = lab.bricktrack("create")
    assert status == 0 and len(public.strip()) == 40 and "host.key_secret" in words
    assert lab.bricktrack("create")[0] == 1  # never over one that is there
    status, shown, _ = lab.bricktrack("show", "--json")
    assert json.loads(shown)["public"] == public.strip()

    assert lab.bricktrack("show", "--output", str(lab.folder / "lab.txt"))[0] == 1
    assert lab.bricktrack("show", "--output", str(lab.folder / "lab.key"))[0] == 0
    assert read_public_key(lab.folder / "lab.key") == public.strip()

    before = lab.fleet.read_text()
    status, said, words = lab.by_ssh("install")
    assert status == 0 and "b1" in said and "(new)" in said, words
    assert (lab.folder / "ssh.log").read_text() == "pi@127.0.0.1\n" * 2
    # One line more, and nothing else changed.
    assert [line for line in lab.fleet.read_text().splitlines() if not line.startswith("server_key")] == (
        before.splitlines()
    )
    assert lab.hello() == "b1"
    assert "(as before)" in lab.by_ssh("install")[1]

    listed = json.loads(lab.bricktrack("list", "--json")[1])
    assert listed["host"]["public"] == public.strip()
    assert listed["units"][0]["server_key"] == UnitKeys(lab.unit_keys).own.public
    assert listed["units"][0]["fingerprint"] in lab.bricktrack("list")[1]


def test_rotation_changes_the_key_and_forbids_the_old_one(lab: Laboratory) -> None:
    lab.bricktrack("create")
    lab.by_ssh("install")
    old = read_secret_key(lab.folder / "host.key_secret")
    status, said, words = lab.by_ssh("rotate")
    assert status == 0 and "accepts the new key" in said, words
    assert read_secret_key(lab.folder / "host.key_secret") != old
    assert read_secret_key(lab.folder / "host.key_secret.old") == old
    assert not (lab.folder / "host.key_secret.next").exists()
    assert lab.hello() == "b1"
    with pytest.raises(UnitError, match="does not know this host's key") as e:
        lab.hello("host.key_secret.old")
    assert e.value.code == "not-allowed"


@pytest.mark.slow
def test_a_rotation_that_does_not_reach_every_unit_locks_nobody_out(lab: Laboratory) -> None:
    lab.bricktrack("create")
    lab.by_ssh("install")
    with_one_more = '[[unit]]\nname = "b2"\naddress = "tcp://offline:41733"\n'
    lab.fleet.write_text(lab.fleet.read_text() + with_one_more + f'server_key = "{make_key_pair().public}"\n')
    before = read_secret_key(lab.folder / "host.key_secret")
    status, said, words = lab.by_ssh("rotate")
    assert status == 1 and "b1: accepts" in said and "no route to host" in words and "1 of 2" in words
    assert read_secret_key(lab.folder / "host.key_secret") == before
    waiting = read_secret_key(lab.folder / "host.key_secret.next")
    assert lab.hello() == lab.hello("host.key_secret.next") == "b1"  # both count
    # When the other unit is gone from the fleet, it goes on with the same new key.
    lab.fleet.write_text(lab.fleet.read_text().split('[[unit]]\nname = "b2"')[0])
    assert lab.by_ssh("rotate")[0] == 0
    assert read_secret_key(lab.folder / "host.key_secret") == waiting


@pytest.mark.slow
def test_a_units_new_key_is_refused_until_it_is_installed(lab: Laboratory) -> None:
    lab.bricktrack("create")
    lab.by_ssh("install")
    create_unit_key(lab.unit_keys, replace=True)
    port = lab.server.port
    lab.server.stop()
    lab.server = FileServer("127.0.0.1", port, Handler("b1"), keys=UnitKeys(lab.unit_keys))
    lab.server.start()
    with pytest.raises(UnitTimeoutError, match="hangs up during the handshake"):
        lab.hello()
    assert "(changed)" in lab.by_ssh("install")[1]
    assert lab.hello() == "b1"


def test_a_host_without_keys_and_a_unit_without_them_are_told_apart(lab: Laboratory) -> None:
    with (
        UnitClient(f"tcp://127.0.0.1:{lab.server.port}", timeout_s=3) as client,
        pytest.raises(UnitError, match="asks for keys, and none is given"),
    ):
        client.hello()
    plain = FileServer("127.0.0.1", 0, Handler("p"))
    plain.start()
    try:
        with (
            UnitClient(
                f"tcp://127.0.0.1:{plain.port}", timeout_s=3, server_key=make_key_pair().public,
                own_keys=make_key_pair(),
            ) as client,
            pytest.raises(UnitError, match="the unit has no keys"),
        ):  # fmt: skip
            client.hello()
    finally:
        plain.stop()


def test_what_cannot_be_done_is_said_with_its_remedy(lab: Laboratory) -> None:
    status, _, words = lab.by_ssh("install")
    assert status == 1 and "host.key_secret" in words
    lab.bricktrack("create")
    lab.fleet.write_text(lab.fleet.read_text().replace('secret_key = "host.key_secret"', ""))
    status, _, words = lab.by_ssh("install")
    assert status == 1 and "bricktrack keys create" in words and "[host]" in words


def test_a_fleet_file_in_another_style_gets_its_line_by_hand_or_right(lab: Laboratory) -> None:
    lab.bricktrack("create")
    port = lab.server.port
    lab.fleet.write_text(
        f'unit = [{{name = "b1", address = "tcp://127.0.0.1:{port}"}}]\n[host]\nsecret_key = "host.key_secret"\n'
    )
    before = lab.fleet.read_text()
    status, _, words = lab.by_ssh("install")
    assert status == 1 and "by hand: server_key" in " ".join(words.split())
    assert lab.fleet.read_text() == before
