"""The output folder: what is kept, in which order, and what counts as there."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.errors import BadInputError
from calib.files import sha256
from calib.fleet.manifest import RigSpec
from calib.fleet.outcome import Outcome
from calib.fleet.store import HIDDEN, Store, check_apart, opened_store
from calib.fleet.task import Answer


def _answer(name: str, text: bytes = b"rig", file: str = "rig.yaml", key: str = "k") -> Answer:
    outcome = Outcome(name, "", "", "ok", 0, key=key, files={file: sha256(text)})
    return Answer(outcome, {file: text})


def test_kept_known_and_damaged(tmp_path: Path) -> None:
    with opened_store(tmp_path / "out", "calib fleet", ("fleet.parquet",)) as (store, interrupted):
        assert not interrupted
        assert store.known("a") == "" and store.outcome("a") is None
        store.keep(_answer("a"))
        assert store.known("a") == "k" and store.result("a", "rig.yaml").read_bytes() == b"rig"
        store.keep(_answer("a", b"other", "firmware/x.h", "k2"))
        assert store.known("a") == "k2" and not store.result("a", "rig.yaml").exists()
        store.result("a", "firmware/x.h").write_bytes(b"edited")
        assert store.known("a") == ""
        store.result("a", "firmware/x.h").unlink()
        assert store.known("a") == ""
    assert not (tmp_path / "out" / HIDDEN / "scratch").exists()


def test_a_failure_is_kept_and_done_again(tmp_path: Path) -> None:
    store = Store(tmp_path)
    (tmp_path / HIDDEN / "outcomes").mkdir(parents=True)
    store.keep(Answer(Outcome("a", "", "", "failed", 3, "not there"), {}))
    found = store.outcome("a")
    assert found is not None and found.sentence == "not there"
    assert store.known("a") == ""


def test_an_outcome_is_gone_before_its_files_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from calib.fleet import store as module

    with opened_store(tmp_path, "calib fleet", ()) as (store, _):
        store.keep(_answer("a"))

        def killed(path: Path, data: bytes | str) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(module, "write_atomically", killed)
        with pytest.raises(KeyboardInterrupt):
            store.keep(_answer("a", b"new", key="k2"))
        assert store.known("a") == ""


@pytest.mark.parametrize("file", ["../evil", "/etc/evil", "a/b/c"])
def test_what_a_worker_must_not_write(tmp_path: Path, file: str) -> None:
    with (
        opened_store(tmp_path / "out", "calib fleet", ()) as (store, _),
        pytest.raises(BadInputError, match="which is no result"),
    ):
        store.keep(_answer("a", file=file))
    assert not (tmp_path / "evil").exists()


def test_one_at_a_time_and_one_verb(tmp_path: Path) -> None:
    with (
        opened_store(tmp_path, "calib fleet", ()),
        pytest.raises(BadInputError, match=r"another calib fleet \(process \d+\) is at work there"),
        opened_store(tmp_path, "calib fleet", ()),
    ):
        pass
    with (
        pytest.raises(BadInputError, match="holds the results of calib fleet"),
        opened_store(tmp_path, "calib sweep", ()),
    ):
        pass


def test_where_nothing_can_be_written(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(BadInputError, match="is a file"), opened_store(file / "out", "calib fleet", ()):
        pass
    (tmp_path / "link").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / HIDDEN).symlink_to(tmp_path / "link")
    with (
        pytest.raises(BadInputError, match="symbolic link"),
        opened_store(tmp_path / "out", "calib fleet", ()),
    ):
        pass
    assert not list((tmp_path / "link").iterdir())


def test_an_interrupted_one_is_told_of(tmp_path: Path) -> None:
    (tmp_path / HIDDEN).mkdir()
    (tmp_path / HIDDEN / "lock").write_text("4242\n")
    with opened_store(tmp_path, "calib fleet", ()) as (_, interrupted):
        assert interrupted


def test_results_that_would_be_written_over_a_rig(tmp_path: Path) -> None:
    rig = tmp_path / "rig1"
    (rig / "images").mkdir(parents=True)
    specs = [RigSpec("far", "s3://bucket/a"), RigSpec("gone", str(tmp_path / "none")), RigSpec("r", str(rig))]
    check_apart(tmp_path / "out", specs)
    check_apart(tmp_path, specs)
    for inside in (rig, rig / "images", rig / "out"):
        with pytest.raises(BadInputError, match="lies in the folder of r, expected another one"):
            check_apart(inside, specs)
    (tmp_path / "link").symlink_to(rig)
    with pytest.raises(BadInputError, match="lies in the folder of r"):
        check_apart(tmp_path / "link" / "out", specs)
    under = [RigSpec("r", str(tmp_path / "rigs" / "a"))]
    with pytest.raises(BadInputError, match="is where results are written"):
        check_apart(tmp_path, under)
    check_apart(tmp_path / "rig", specs)


def test_rigs_that_no_fleet_has_made_are_not_touched(tmp_path: Path) -> None:
    (tmp_path / "rigs" / "a").mkdir(parents=True)
    (tmp_path / "rigs" / "a" / "rig.yaml").write_text("mine")
    with (
        pytest.raises(BadInputError, match="is there, and is not the work of calib fleet"),
        opened_store(tmp_path, "calib fleet", ()),
    ):
        pass
    assert (tmp_path / "rigs" / "a" / "rig.yaml").read_text() == "mine"
    assert not (tmp_path / HIDDEN).exists()
