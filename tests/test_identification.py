"""The chain from tracks to a verdict, and how long it takes in steps rather than in seconds."""

from __future__ import annotations

import numpy as np
from identifytrials import SIGMA, pump_records, track

from calib.actuator.identify_parameters import Nominal
from calib.actuator.identify_pump_models import LAG
from calib.identification import identify_logs, identify_pump, simulated_heads
from calib.identifying import TrackSource
from calib.pumptables import PumpTable


def test_swings_go_through_the_whole_chain() -> None:
    tracks = [track("free", phi_rad=phi, seed=k) for k, phi in enumerate((0.5, -0.4))]
    found = identify_logs(Nominal(), [TrackSource(t, "test", 0.025, ()) for t in tracks])
    assert len(found.held) == len(found.rms) == len(found.colours) == 2
    assert found.judgement.verdict in ("ok", "poor")
    assert (
        abs(found.solution.values["stiffness_scale"] - 1.0) < 4.0 * found.uncertainty.sigma["stiffness_scale"]
    )
    for one, head in zip(tracks, simulated_heads(found.solution), strict=True):
        assert np.std(one.head[:, 0] - head[:, 0]) < 1.3 * SIGMA[0]
    seen, fitted = found.decrements["free"]
    assert fitted is not None
    assert abs(seen.zeta - fitted) < 4.0 * seen.sigma + 0.005


def test_tables_that_are_kept_out_are_predicted() -> None:
    lag = np.array([0.06, 25.0, 0.5, 1e6])
    tables = [PumpTable("kPa", r, (), ()) for r in pump_records(LAG, lag, 3)]
    found = identify_pump(tables[:2], tables[2:])
    assert [h.name for h in found.asked[LAG]] == ["run2"]
    assert found.asked[LAG][0].rms < 0.15
    assert found.better == LAG
