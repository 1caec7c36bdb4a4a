"""What fleets and sweeps share on the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.cli.clusters import check_places, opened_out
from calib.core.errors import UsageError


def test_an_existing_cluster_or_processes_of_ones_own() -> None:
    check_places(None, None)
    check_places("tcp://x:1", None)
    check_places(None, 2)
    with pytest.raises(UsageError, match="give --scheduler alone"):
        check_places("tcp://x:1", 2)


def test_an_interrupted_run_is_told_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with opened_out(tmp_path, "calib fleet", ()) as store:
        assert store.out == tmp_path
    assert capsys.readouterr().err == ""
    (tmp_path / ".fleet" / "lock").write_text("4242\n")
    with opened_out(tmp_path, "calib fleet", ()):
        pass
    assert "was interrupted; going on where it stopped" in capsys.readouterr().err
