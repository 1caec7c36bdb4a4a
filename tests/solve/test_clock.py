"""The time axis is held to the stamps: over fuzzed clocks whose truth is known, and over real ones."""

from __future__ import annotations

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.core.arrays import BoolArray, FloatArray
from calib.solve.clock import TimeAxis, clock_step_s, time_axis


def _held(axis: TimeAxis, stamps: FloatArray, jitter_s: float) -> None:
    """What holds of every axis: the stamps' span, and no sample that moves by more than their jitter."""
    assert axis.t_s.shape == stamps.shape
    assert np.isfinite(axis.t_s).all()
    assert (np.diff(axis.t_s) >= 0.0).all()
    for first, last in zip(axis.starts, [*axis.starts[1:], len(stamps)], strict=True):
        assert axis.places[first] == 0
        assert (np.diff(axis.places[first:last]) > 0).all()
    assert np.abs(axis.t_s - stamps).max() <= jitter_s
    assert abs((axis.t_s[-1] - axis.t_s[0]) - (stamps[-1] - stamps[0])) <= 2.0 * jitter_s
    parts = axis.parts(stamps[:, None])
    assert sum(len(part.rows) for part in parts) == len(stamps)
    for part, even in zip(parts, axis.even, strict=True):
        assert len(part.t_s) == len(part.values) > part.places[-1]
        assert [part.t_s[0], part.t_s[-1]] == pytest.approx(axis.t_s[part.rows[[0, -1]]].tolist(), abs=1e-9)
        assert (np.diff(part.t_s) >= 0.0).all()
        if even:
            assert np.array_equal(part.t_s[part.places], axis.t_s[part.rows])
            assert np.array_equal(part.values[part.places, 0], stamps[part.rows])


KINDS = ("even", "adds up", "drifts", "bursts", "polled", "stalls")


@st.composite
def clocks(draw: st.DrawFn) -> tuple[FloatArray, FloatArray, float, bool]:
    """Times of samples, their stamps, the most by which a stamp is off, and whether steps are uneven."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, T = draw(st.integers(2, 3000)), draw(st.sampled_from((0.001, 0.0049, 0.01, 0.0167, 0.05)))
    k = np.arange(n)
    taken = draw(st.sampled_from((0.0, 3.0, 1.7e9))) + T * k
    kind = draw(st.sampled_from(KINDS))
    if kind == "adds up":
        taken = taken[0] + np.cumsum(T * rng.uniform(0.4, 1.9, n))
    elif kind == "drifts":
        slow_s = draw(st.sampled_from((60.0, 900.0)))
        taken = taken + 0.005 * slow_s * np.sin((taken - taken[0]) / slow_s)
    if draw(st.booleans()):
        keep = rng.random(n) > draw(st.sampled_from((0.01, 0.1, 0.4)))
        keep[[0, -1]] = True
        taken = taken[keep]
    gaps = [draw(st.sampled_from((0.3, 2.0, 1000.0))) for _ in range(draw(st.integers(0, 3)))]
    for gap_s in gaps:
        # A single sample before a gap or behind it is the hardest.
        taken[draw(st.sampled_from((1, int(rng.integers(len(taken))), len(taken) - 1))) :] += gap_s
    stamps = taken
    if kind == "bursts":
        size = draw(st.integers(2, 40))
        last = np.minimum((np.arange(len(taken)) // size + 1) * size, len(taken)) - 1
        stamps = taken[last]
    elif kind == "polled":
        stamps = taken[0] + np.ceil((taken - taken[0]) / (2.7 * T)) * 2.7 * T
    elif kind == "stalls":
        late = np.where(rng.random(len(taken)) < 0.03, rng.uniform(0.0, 8.0 * T, len(taken)), 0.0)
        stamps = np.maximum.accumulate(taken + late)
    share = draw(st.sampled_from((0.0, 0.01, 0.1, 0.3)))
    stamps = np.maximum.accumulate(stamps + share * T * rng.standard_normal(len(taken)))
    for i in np.flatnonzero(rng.random(len(taken)) < draw(st.sampled_from((0.0, 0.01)))).tolist():
        stamps[i] = stamps[max(i - 1, 0)]
    if T > 0.004 and draw(st.booleans()):
        stamps = np.round(stamps, 3)
    return taken, stamps, float(np.abs(stamps - taken).max()), kind == "adds up" or 0.3 in gaps


@settings(max_examples=300, deadline=None)
@given(clocks())
def test_the_axis_is_held_to_its_stamps(clock: tuple[FloatArray, FloatArray, float, bool]) -> None:
    taken, stamps, jitter_s, uneven = clock
    axis = time_axis(stamps)
    # A clock that bends by less than a hundredth of a period is taken for a straight one. Uneven steps may
    # look even for a while, and the one to the first sample after a stall is no whole number of periods.
    slack = float(np.nan_to_num((1.0 if uneven else 0.01) * axis.period_s)) + 1e-6
    _held(axis, stamps, 2.0 * jitter_s + slack)
    # What is moved is moved towards the truth.
    assert uneven or np.std(axis.t_s - taken) <= 1.5 * np.std(stamps - taken) + slack


@pytest.mark.parametrize("name", ["softbot", "softarm", "imufusion", "imu_tk"])
def test_real_clocks(shared_data: Path, name: str) -> None:
    clocks: list[FloatArray] = []
    for path in sorted((shared_data / name).glob("*.csv")):
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = list(csv.reader(stream))
        at = [
            i for i, cell in enumerate(rows[0]) if cell.strip() in ("t_s", "Time", "Time (s)", "Timestamp_s")
        ]
        if at:
            clocks.append(np.array([float(row[at[0]]) for row in rows[1:]]))
    for path in sorted((shared_data / name).glob("*.gz")):
        with gzip.open(path, "rt") as stream:
            clocks.append(np.array([float(line.split()[0]) for line in stream if line.strip()]))
    assert clocks
    for stamps in clocks:
        axis = time_axis(stamps)
        _held(axis, stamps, 0.3 * axis.period_s)


def _stamped(taken: FloatArray, jitter: float, repeated: float, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    t = np.maximum.accumulate(taken + jitter * rng.standard_normal(len(taken)))
    for i in np.flatnonzero(rng.random(len(t)) < repeated):
        t[i] = t[max(i - 1, 0)]
    return t


@pytest.mark.parametrize("step_s", [0.004, 1 / 128, 0.01, 1 / 64, 0.02])
@pytest.mark.parametrize("period_s", [0.01, 1 / 60])
def test_a_clock_of_coarse_steps_is_followed_through_them(step_s: float, period_s: float) -> None:
    """Cut to its steps, of a sensor that jitters: all samples are late alike, by half a step."""
    taken = 100.0 + period_s * np.arange(3000) + 4e-4 * np.random.default_rng(0).standard_normal(3000)
    stamps = np.floor(taken / step_s) * step_s
    axis = time_axis(stamps)
    if 0.85 * period_s < step_s < period_s:
        assert axis.missing
        return
    late = taken - axis.t_s
    assert axis.steady and not axis.missing
    assert axis.period_s == pytest.approx(period_s, rel=2e-5)
    assert np.std(late) < 6e-4 < 0.2 * np.std(taken - stamps) + 4e-4
    assert late.mean() == pytest.approx(0.5 * step_s, abs=0.1 * step_s)


def test_the_step_of_a_clock() -> None:
    rng = np.random.default_rng(0)
    taken = np.cumsum(rng.uniform(0.005, 0.02, 500))
    assert clock_step_s(taken) == 0.0
    assert clock_step_s(np.round(taken, 2)) == pytest.approx(0.01)
    assert clock_step_s((1e5 + taken).astype(np.float32).astype(float)) == 1 / 128
    assert clock_step_s(1.7e9 + 0.01 * np.arange(500)) == pytest.approx(0.01, rel=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_jitter_and_repeated_stamps_leave_microseconds(seed: int) -> None:
    taken = 3.0 + 0.0100003 * np.arange(4000)
    axis = time_axis(_stamped(taken, 4e-4, 0.002, seed))
    # The line through 4000 stamps has the deviation 2 * 0.4 ms / sqrt(4000) at its ends; four of that.
    assert np.abs(axis.t_s - taken).max() < 4 * 2 * 4e-4 / np.sqrt(4000)
    # Its slope has the deviation 0.4 ms sqrt(12 / 4000^3), and four of that are allowed.
    assert axis.period_s == pytest.approx(0.0100003, abs=4 * 4e-4 * np.sqrt(12 / 4000**3))
    assert axis.jitter_s == pytest.approx(4e-4, rel=0.1)
    assert axis.missing == 0
    assert axis.repeated > 0


@pytest.mark.parametrize("share", [0.01, 0.3])
def test_missing_samples_are_counted(share: float) -> None:
    taken = np.arange(3000) / 60.0
    keep: BoolArray = np.random.default_rng(1).random(3000) > share
    keep[500:524] = False
    axis = time_axis(_stamped(taken[keep], 2e-4, 0.0, 2))
    kept = np.flatnonzero(keep)
    assert np.array_equal(axis.places, kept - kept[0])
    assert np.abs(axis.t_s - taken[keep]).max() < 6e-5
    (part,) = axis.parts(taken[keep][:, None])
    assert np.abs(part.values[:, 0] - part.t_s).max() < 1e-4


def test_a_gap_at_the_end_of_the_first_chunk_does_not_bend_its_line() -> None:
    rng = np.random.default_rng(5)
    taken = 0.01 * np.arange(2000)[rng.random(2000) >= 0.02]
    axis = time_axis(np.maximum.accumulate(taken + 1e-3 * rng.standard_normal(len(taken))))
    assert axis.steady
    assert np.abs(axis.t_s - taken).max() < 5e-4


@pytest.mark.parametrize(
    ("missing", "jitter_s", "seed"),
    [(0.1, 0.005, seed) for seed in (73, 178, 250, 289, 974, 1497)]
    + [(0.4, 0.0005, seed) for seed in range(8)],
)
def test_gaps_of_a_clock_that_bends_come_to_their_places(missing: float, jitter_s: float, seed: int) -> None:
    """Many single samples are missing; gaps found some samples late hide what the clock wanders."""
    rng = np.random.default_rng(seed)
    taken = 0.05 * np.arange(1700)
    taken = taken + 0.3 * np.sin(taken / 60.0)
    keep = rng.random(1700) > missing
    keep[[0, -1]] = True
    stamps = np.maximum.accumulate(taken[keep] + jitter_s * rng.standard_normal(keep.sum()))
    axis = time_axis(stamps)
    assert np.array_equal(axis.places, np.flatnonzero(keep))
    _held(axis, stamps, 2.0 * float(np.abs(stamps - taken[keep]).max()))


def test_a_gap_within_a_short_stretch_makes_no_bursts() -> None:
    """Steps are far from even, so that stamps stay; of most pairs 64 samples apart one is beyond the gap."""
    taken = np.cumsum(0.001 * np.random.default_rng(106).uniform(0.4, 1.9, 149))
    taken[75:] += 0.3
    assert np.abs(time_axis(taken).t_s - taken).max() <= 0.001


def test_equal_stamps_at_the_clock_s_last_digit() -> None:
    stamps = np.full(39, 1.7e9)
    stamps[-1] += 2e-5
    axis = time_axis(stamps)
    _held(axis, stamps, 0.0)


def test_a_clock_that_wanders_is_followed() -> None:
    taken = 0.01 * np.arange(12000)
    wander = 3e-3 * np.sin(2.0 * np.pi * taken / 90.0)
    axis = time_axis(_stamped(taken + wander, 4e-4, 0.0, 3))
    assert np.abs(axis.t_s - taken - wander)[500:-500].max() < 4e-4


def test_delays_that_add_up_are_no_jitter() -> None:
    t = np.cumsum(np.random.default_rng(0).choice([0.020, 0.021], 400))
    assert np.array_equal(time_axis(t).t_s, t)


def test_stamps_that_are_not_steady_stay() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.05, 400))
    axis = time_axis(t)
    assert not axis.steady
    assert np.array_equal(axis.t_s, t)
    assert axis.period_s == pytest.approx((t[-1] - t[0]) / 399)
    assert np.array_equal(time_axis(t[:4]).t_s, t[:4])


def test_short_stretches_are_counted_too() -> None:
    taken = 3602.0 + 0.01 * np.arange(120)
    for seed in range(300):
        axis = time_axis(_stamped(taken, 4e-4, 0.005, seed))
        assert axis.missing == 0
        assert np.abs(axis.t_s - taken).max() < 6 * 2 * 4e-4 / np.sqrt(120)


@pytest.mark.parametrize("at", [1, 1468, 2927])
def test_a_single_burst_before_a_gap_stays(at: int) -> None:
    """A logger that polls at 2.7 periods writes bursts, of which the first or the last stands alone."""
    taken = 0.0049 * np.arange(2928)
    taken[at:] += 0.3
    stamps = taken[0] + np.ceil(taken / (2.7 * 0.0049)) * 2.7 * 0.0049
    # To the digit of rounding.
    _held(time_axis(stamps), stamps, 2.7 * 0.0049 + 1e-12)


@pytest.mark.parametrize(
    ("periods", "lost", "within_s"),
    [(1.7, 0.0, 5e-4), (2.7, 0.0, 5e-4), (3.5, 0.0, 5e-4), (8.3, 0.0, 1e-3), (12.3, 0.0, 2e-3),
     (2.7, 0.004, 4e-3), (3.5, 0.004, 2e-3), (8.3, 0.004, 5e-3), (12.3, 0.004, 8e-3)],
)  # fmt: skip
def test_samples_of_a_buffer_get_the_times_when_they_were_taken(
    periods: float, lost: float, within_s: float
) -> None:
    """They wait up to a period, and for the others of their burst; where some are lost a period is unsure."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        taken = 0.01 * np.arange(6000)
        taken = taken[rng.random(len(taken)) >= lost]
        reads = np.cumsum(np.full(6000, periods * 0.01)) + rng.exponential(3e-4, 6000)
        axis = time_axis(reads[np.searchsorted(reads, taken)])
        assert axis.burst > 1
        assert np.sqrt(np.mean((axis.t_s - taken) ** 2)) < within_s


@pytest.mark.parametrize(("jitter", "burst"), [(0.1, 1), (0.6, 1), (0.02, 5), (0.1, 5)])
def test_how_well_all_times_are_known_together(jitter: float, burst: int) -> None:
    """Of single samples, of some that are not steady, and of a buffer that is read as it is full: with its
    least late readings for the times of its last samples all were 1.6 jitters early."""
    scores, taken = [], 0.01 * np.arange(600)
    for seed in range(40):
        late = 0.01 * jitter * np.random.default_rng(seed).standard_normal(len(taken) // burst)
        axis = time_axis(np.maximum.accumulate(np.repeat(taken[burst - 1 :: burst] + late, burst)))
        assert axis.steady == (jitter < 0.5)
        shift = float(
            (axis.t_s - taken).mean() - (0.0 if axis.steady else (axis.stamps_s - taken - late).mean())
        )
        scores.append(shift / axis.shift_sigma_s)
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.5


def test_a_long_gap_splits() -> None:
    t = 0.01 * np.arange(6000)
    t[4000:] += 3600.0
    axis = time_axis(_stamped(t, 4e-4, 0.0, 0))
    assert axis.starts.tolist() == [0, 4000]
    (gap,) = axis.gaps
    assert gap.split
    assert gap.duration_s == pytest.approx(3600.01, abs=1e-3)
    assert axis.jitter_s == pytest.approx(4e-4, rel=0.15)
    assert [len(part.values) for part in axis.parts(t[:, None])] == [4000, 2000]


def test_a_log_of_late_steps_is_not_stretched() -> None:
    """Each late step would gain a sample if it were rounded for itself."""
    rng = np.random.default_rng(0)
    late = np.where(rng.random(16000) < 0.12, rng.uniform(0.5, 0.9, 16000), rng.normal(0.0, 0.02, 16000))
    t = np.cumsum(0.0102 * (1.0 + late))
    parts = time_axis(t).parts(t[:, None])
    assert sum(float(part.t_s[-1] - part.t_s[0]) for part in parts) == pytest.approx(t[-1] - t[0])


@pytest.mark.parametrize("n", [0, 1, 2])
def test_hardly_any_samples(n: int) -> None:
    assert len(time_axis(np.zeros(n)).t_s) == n
    assert np.isnan(time_axis(np.zeros(n)).period_s)


@pytest.mark.parametrize(
    ("rate_hz", "nominal_hz"),
    [
        (59.94, 60.0),
        (30.08, 30.0),
        (62.4, 62.5),
        (33.3, 1e3 / 30.0),
        (99.6, 100.0),
        (40.45, 40.45),
    ],
)
def test_a_measured_rate_is_near_one_that_somebody_set(rate_hz: float, nominal_hz: float) -> None:
    assert time_axis(np.arange(400) / rate_hz).nominal_hz == pytest.approx(nominal_hz)
