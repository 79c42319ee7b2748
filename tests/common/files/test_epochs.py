"""Claims of epochs: each process proves that it succeeds the one before, also over restarts of the supervisor."""

import itertools
import os
import subprocess
import sys

import pytest

from beamsplat.common.files.epochs import RESERVED, EpochClaims
from beamsplat.common.messages.instances import CHAIN_EPOCHS, ProcessId, is_proven_successor, process_of


def claims(folder, faults=None):
    return EpochClaims(folder, faults.append if faults is not None else pytest.fail)


def test_every_process_of_a_supervisor_is_the_proven_successor_of_the_one_before(tmp_path):
    supervisor = claims(tmp_path)
    processes = [supervisor.claim("depth") for _ in range(3 * RESERVED)]
    for before, after in itertools.pairwise(processes):
        assert after.epoch == before.epoch + 1
        assert is_proven_successor(after, before)
        assert not is_proven_successor(before, after)
    assert is_proven_successor(processes[40], processes[0])
    assert len({p.instance for p in processes}) == len(processes)


def test_another_supervisor_of_the_folder_continues(tmp_path):
    first = claims(tmp_path)
    process = first.claim("depth")
    second = claims(tmp_path).claim("depth")
    assert is_proven_successor(second, process)
    assert is_proven_successor(second, first.claim("depth"))
    assert is_proven_successor(claims(tmp_path).claim("depth"), second)


def test_the_seed_is_readable_by_its_owner_only(tmp_path):
    claims(tmp_path).claim("depth")
    assert (tmp_path / "epochs" / "depth").stat().st_mode & 0o777 == 0o600


def test_a_folder_of_an_older_version_keeps_its_epochs(tmp_path):
    (tmp_path / "epochs").mkdir()
    (tmp_path / "epochs" / "depth").write_text("41")
    assert claims(tmp_path).claim("depth").epoch == 42


@pytest.mark.parametrize("content", ["", "{}", '{"epoch": 3}', '{"epoch": 3, "seed": "x"}', "[]", '"a"'])
def test_a_damaged_file_is_reported_and_claims_continue_in_memory(tmp_path, content):
    (tmp_path / "epochs").mkdir()
    (tmp_path / "epochs" / "depth").write_text(content)
    faults = []
    supervisor = claims(tmp_path, faults)
    first, second = supervisor.claim("depth"), supervisor.claim("depth")
    assert is_proven_successor(second, first)
    assert len(faults) == 1
    assert f"{tmp_path}/epochs/depth: the epochs of depth cannot be stored" in faults[0]


def test_a_disk_that_fills_up_or_becomes_read_only_stops_no_restart(tmp_path):
    """As a user without rights: root may write anywhere."""
    script = (
        "import os, sys, pathlib\n"
        "from beamsplat.common.files.epochs import EpochClaims\n"
        "from beamsplat.common.messages.instances import is_proven_successor\n"
        "folder, faults = pathlib.Path(sys.argv[1]), []\n"
        "os.chmod(folder, 0o777)\n"
        "if os.getuid() == 0: os.setuid(65534)\n"
        "supervisor = EpochClaims(folder, faults.append)\n"
        "before = supervisor.claim('depth')\n"
        "os.chmod(folder / 'epochs', 0o500)\n"
        "for number in range(40):\n"
        "    after = supervisor.claim('depth')\n"
        "    assert is_proven_successor(after, before) == (number != 31), number\n"
        "    assert after.epoch == before.epoch + 1\n"
        "    before = after\n"
        "print(*faults, sep='\\n')\n"
    )
    for folder in (tmp_path, *tmp_path.parents):  # pytest's folders are for their owner only
        if (
            folder.owner() == tmp_path.owner()
            and os.getuid() == 0
            and folder.name.startswith(("pytest", "popen"))
        ):
            folder.chmod(0o755)
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (fault,) = done.stdout.splitlines()
    assert "Permission denied" in fault


@pytest.mark.parametrize("epoch", [1, 2, CHAIN_EPOCHS - 1, CHAIN_EPOCHS, 2**32 - 1])
def test_the_instance_of_an_epoch_depends_on_seed_and_node(epoch):
    process = process_of(b"seed", "depth", epoch)
    assert process == process_of(b"seed", "depth", epoch)
    assert len(bytes.fromhex(process.instance)) == 8
    assert process.instance != process_of(b"other", "depth", epoch).instance
    assert process.instance != process_of(b"seed", "fusion", epoch).instance


def test_nothing_but_the_chain_is_a_proof():
    known, after = process_of(b"seed", "depth", 10), process_of(b"seed", "depth", 12)
    assert is_proven_successor(after, known)
    assert not is_proven_successor(after._replace(epoch=13), known)
    assert not is_proven_successor(after._replace(node="fusion"), known)
    assert not is_proven_successor(known._replace(epoch=11), known)
    assert not is_proven_successor(ProcessId("depth", 2**32 - 1, "00" * 8), known)
    assert not is_proven_successor(known, known)
