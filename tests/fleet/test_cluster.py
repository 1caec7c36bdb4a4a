"""Workers with another program, and schedulers that are not there."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path

import pytest

from calib.core.errors import BadInputError
from calib.runner import engine as cluster
from calib.runner.engine import check_survey, connected, survey

pytest.importorskip("distributed")


def test_workers_with_another_program_are_refused() -> None:
    mine = replace(survey(), blas_threads="1")
    assert check_survey({"tcp://a": mine, "tcp://b": mine}, mine) == ()
    with pytest.raises(BadInputError, match=r"worker tcp://b: has calib 9\.9"):
        check_survey({"tcp://a": mine, "tcp://b": replace(mine, version="9.9", program="x")}, mine)
    with pytest.raises(BadInputError, match="another source of calib"):
        check_survey({"tcp://b": replace(mine, program="x")}, mine)
    (remark,) = check_survey({"tcp://a": mine, "tcp://b": replace(mine, blas_threads="")}, mine)
    assert "1 of 2 workers" in remark and "OPENBLAS_NUM_THREADS" in remark


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("tcp://127.0.0.1:{port}", "no scheduler answers there within 0.5 s"),
        ("nonsense://x:1", "cannot be talked to|no scheduler answers"),
    ],
)
def test_nobody_at_the_address(
    address: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
    with socket.socket() as taken:
        # Bound but not listening: whoever connects is refused.
        taken.bind(("127.0.0.1", 0))
        where = address.format(port=taken.getsockname()[1])
        with pytest.raises(BadInputError, match=said), connected(where, 1, tmp_path / "w", 1):
            pass
    assert not (tmp_path / "w").exists()


def test_a_scheduler_without_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
    with (
        LocalCluster(
            n_workers=0, processes=False, dashboard_address="127.0.0.1:0", host="127.0.0.1", protocol="tcp"
        ) as there,
        pytest.raises(BadInputError, match="has no workers"),
        connected(there.scheduler_address, 1, tmp_path, 1),
    ):
        pass
