"""Columns of logs as people have them: names, units, marks, and the evidence where nobody states them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.options import LogOptions
from calib.io.columns import COLUMNS, known_name
from calib.io.logs import Log, read_log, write_log

G, DEGREE = 9.80665, math.pi / 180.0
NAMED = "t_s ax_mps2 ay_mps2 az_mps2 gx_radps gy_radps gz_radps"
AXES = ("ax_mps2", "ay_mps2", "az_mps2", "gx_radps", "gy_radps", "gz_radps")


def _imu(moving: bool = True, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Times and readings of a sensor in the plane: slow bending, or rest, and the noise of a cheap chip."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(3000)
    phi = (0.5 if moving else 0.0) * np.sin(1.3 * t)
    rate = (0.65 if moving else 0.0) * np.cos(1.3 * t)
    zero = np.zeros_like(t)
    values = np.stack([G * np.cos(phi), G * np.sin(phi), zero, zero, zero, -rate], axis=1)
    return t, values + rng.normal(size=values.shape) * ([0.015] * 3 + [0.0025] * 3) + 0.004


def _written(
    path: Path, names: list[str], columns: list[FloatArray], mark: str = ",", comma: str = ".", head: str = ""
) -> Path:
    table = np.column_stack(columns)
    rows = [mark.join(f"{value:.9g}".replace(".", comma) for value in row) for row in table]
    path.write_text("\n".join([head or mark.join(names), *rows, ""]), encoding="utf-8-sig")
    return path


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("millis", ("t_s", "ms")),
        ("Time (ms)", ("t_s", "ms")),
        ("timestamp [ns]", ("t_s", "ns")),
        ("time_us", ("t_s", "us")),
        ("timestamp", ("t_s", "")),
        ("accel_x", ("ax_mps2", "")),
        ("ax", ("ax_mps2", "")),
        ("Accelerometer X (g)", ("ax_mps2", "g")),
        ("imu.linear_acceleration.y", ("ay_mps2", "")),
        ("%time", ("t_s", "")),
        ("#timestamp [ns]", ("t_s", "ns")),
        ("a_RS_S_z [m s^-2]", ("az_mps2", "m/s2")),
        ("gyro_z", ("gz_radps", "")),
        ("GyroZ_dps", ("gz_radps", "deg/s")),
        ("w_RS_S_x [rad s^-1]", ("gx_radps", "rad/s")),
        ("Gyroscope Y (deg/s)", ("gy_radps", "deg/s")),
        ("u", ("u_px", "px")),
        ("pixy_y", ("v_px", "px")),
        ("duty1", ("pwm1", "pwm")),
        ("onchip_phi_deg", ("onchip_phi_rad", "deg")),
        ("AcX", ("ax_mps2", "")),
        ("GyZ", ("gz_radps", "")),
        ("zAccl", ("az_mps2", "")),
        ("xGyro", ("gx_radps", "")),
        ("seconds_elapsed", ("t_s", "s")),
        ("time_boot_ms", ("t_s", "ms")),
        ("Zeit (s)", ("t_s", "s")),
        ("Uhrzeit", ("t_s", "")),
        ("Beschleunigung X (m/s²)", ("ax_mps2", "m/s2")),
        ("Drehrate z (°/s)", ("gz_radps", "deg/s")),
        ("Gyro z (Grad/s)", ("gz_radps", "deg/s")),
        ("accélération y [g]", ("ay_mps2", "g")),
        ("velocità angolare z", ("gz_radps", "")),
        ("Magnetometer X (uT)", None),
        ("x [px]", ("u_px", "px")),
        ("duty1 (%)", ("pwm1", "percent")),
        ("millis [s]", None),
        ("gyro_x_mdeg/s", ("gx_radps", "mdeg/s")),
        ("temperature", None),
        ("gear", None),
        ("mag_x", None),
        ("ax_uT", None),
    ],
)
def test_names_that_people_give(name: str, column: tuple[str, str] | None) -> None:
    assert known_name(name) == column


def test_the_names_of_the_format_mean_themselves() -> None:
    for name in ("t_s", *COLUMNS):
        found = known_name(name)
        assert found is not None
        assert found[0] == name


@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize(("acc", "gyro"), [("g", "deg/s"), ("m/s2", "rad/s")])
@pytest.mark.parametrize(("time", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6)])
def test_units_are_inferred_from_the_readings(
    tmp_path: Path, moving: bool, acc: str, gyro: str, time: str, scale: float
) -> None:
    t, values = _imu(moving)
    per = {"g": 1 / G, "m/s2": 1.0}[acc], {"deg/s": 1 / DEGREE, "rad/s": 1.0}[gyro]
    columns = [scale * t, *(per[0] * values[:, :3]).T, *(per[1] * values[:, 3:]).T]
    path = _written(tmp_path / "log.csv", ["time", "ax", "ay", "az", "gx", "gy", "gz"], columns)
    log = read_log(path)
    assert np.allclose(log.t_s, t)
    assert np.allclose(np.stack([log.columns[name] for name in AXES], axis=1), values, rtol=1e-6, atol=1e-6)
    assert log.map is not None
    assert f"read as: time in {time} from `time` (" in log.map.narration
    assert f"accelerations in {acc} from `ax`, `ay`, `az` (the specific force is" in log.map.narration
    assert f"rates in {gyro} from `gx`, `gy`, `gz` (in " in log.map.narration
    # What was inferred can be stated, and is read the same.
    (tmp_path / "columns.yaml").write_text(log.map.text())
    again = read_log(path)
    assert again.map is not None and not again.map.evidence
    for name in AXES:
        assert np.array_equal(again.columns[name], log.columns[name])


@pytest.mark.parametrize(("mark", "comma"), [(";", ","), (";", "."), ("\t", ",")])
def test_marks_of_other_countries(tmp_path: Path, mark: str, comma: str) -> None:
    t, values = _imu()
    names = ["t_s", *AXES]
    log = read_log(_written(tmp_path / "log.csv", names, [t, *values.T], mark, comma))
    plain = read_log(_written(tmp_path / "plain.csv", names, [t, *values.T]))
    assert all(np.array_equal(log.columns[name], plain.columns[name]) for name in AXES)


@pytest.mark.parametrize("header", ["t_s " + " ".join(AXES), "# t_s " + " ".join(AXES)])
def test_blanks_between_cells_as_savetxt_writes_them(tmp_path: Path, header: str) -> None:
    t, values = _imu()
    path, plain = tmp_path / "log.txt", _written(tmp_path / "plain.csv", ["t_s", *AXES], [t, *values.T])
    np.savetxt(path, np.column_stack([t, values]), "%14.9g", header=header, comments="")
    # A last line that is still being written is no row.
    path.write_text(path.read_text() + "  30.0 0.1")
    log, expected = read_log(path), read_log(plain)
    assert np.array_equal(log.t_s, expected.t_s) and log.passed.truncated
    assert all(np.allclose(log.columns[name], expected.columns[name], rtol=1e-8) for name in AXES)


def test_rows_without_a_time_are_counted_at_the_rate_that_is_stated(tmp_path: Path) -> None:
    t, values = _imu()
    names = ["Counter", "Acc_X", "Acc_Y", "Acc_Z", "Gyr_X", "Gyr_Y", "Gyr_Z"]
    count = np.arange(len(t), dtype=np.float64)
    head = "// a device\n// Rate: 100 Hz\n" + ",".join(names)
    path = _written(tmp_path / "log.csv", names, [count, *values.T], head=head)
    # A mark after the last cell, which the header has not.
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    path.write_text("\n".join([*lines[:3], *(line + "," for line in lines[3:])]) + "\n")
    words = r"line 3: has no column t_s, .*if Counter counts samples, t_s: \{column: Counter, .*rate_hz: RATE"
    with pytest.raises(BadInputError, match=words):
        read_log(path)
    (tmp_path / "columns.yaml").write_text("t_s: {column: Counter, factor: 0.01}\n")
    by_counter = read_log(path)
    (tmp_path / "columns.yaml").write_text("rate_hz: 100\n")
    counted = read_log(path)
    assert counted.map is not None and "times counted in rows at 100 Hz" in counted.map.narration
    (tmp_path / "columns.yaml").write_text(counted.map.text())
    again = read_log(path)
    for log in (by_counter, counted, again):
        assert np.allclose(log.t_s, count / 100.0, rtol=0.0, atol=1e-9)
        assert np.allclose(log.columns["gz_radps"], values[:, 5])
    parquet = tmp_path / "log.parquet"
    table = pyarrow.table({name: values[:, k] for k, name in enumerate(AXES)})
    pyarrow.parquet.write_table(table, parquet)
    assert np.array_equal(read_log(parquet).t_s, counted.t_s)
    timed = _written(tmp_path / "timed.csv", ["t_s", *AXES], [t, *values.T])
    with pytest.raises(BadInputError, match=r"has the time `t_s`, and .* says rate_hz"):
        read_log(timed)


@pytest.mark.parametrize(
    "above", ["Initializing...\n\nfound it at 0x68, ready\n", "7,0.1\n", "The time is now, ready\n"]
)
def test_what_a_board_says_above_the_header_is_passed_over(tmp_path: Path, above: str) -> None:
    t, values = _imu()
    path = _written(tmp_path / "log.csv", ["millis", *AXES], [1e3 * t, *values.T])
    plain = read_log(path)
    path.write_text(above + path.read_text(encoding="utf-8-sig"))
    log = read_log(path)
    assert all(np.array_equal(log.columns[name], plain.columns[name]) for name in AXES)
    assert log.lines[0] == plain.lines[0] + above.count("\n")
    assert log.map is not None and f"the table from line {log.lines[0] - 1} on, below" in log.map.narration


def test_a_file_without_a_header(tmp_path: Path) -> None:
    t, values = _imu()
    columns = [1e3 * t, *values[:, [0, 1, 5]].T]
    path = _written(tmp_path / "log.csv", [], columns, head="# a logger, 2024")
    with pytest.raises(BadInputError, match=r"line 2: holds numbers.*yaml the line names: \[t_s.*4 columns"):
        read_log(path)
    (tmp_path / "columns.yaml").write_text("names: [millis, ax, ay, gz]\n")
    named = read_log(path)
    text = "t_s: {column: 1, unit: ms}\nax_mps2: 2\nay_mps2: 3\ngz_radps: 4\n"
    (tmp_path / "columns.yaml").write_text(text)
    numbered = read_log(path)
    (tmp_path / "columns.yaml").write_text(text + "gy_radps: 4\n")
    shared = read_log(path).columns
    assert np.array_equal(shared["gy_radps"], shared["gz_radps"])
    (tmp_path / "columns.yaml").unlink()
    above = read_log(_written(path, [], columns, head="#millis,ax,ay,gz"))
    for log in (named, numbered, above):
        assert np.allclose(log.t_s, t)
        assert np.allclose(log.columns["gz_radps"], values[:, 5])


@pytest.mark.parametrize(
    ("names", "factors", "options", "words"),
    [
        # A name that states another unit than the readings have.
        (NAMED, (1e3, 1, 1), {}, r"t_s steps by 10, in s that is 0.1 .* line t_s: \{column: t_s, unit: ms\}"),
        (NAMED, (1, 1 / G, 1), {}, r"is in g, not in m/s2; give --acc-unit g or .*units: \{accel: g\}"),
        (NAMED, (1, 1, 1 / DEGREE), {}, r"in deg/s, give --gyro-unit deg/s or .*units: \{gyro: deg/s\}"),
        # A person who does.
        (NAMED, (1, 1, 1), {"acc_unit": "g"}, "is in m/s2, not in g; give --acc-unit m/s2"),
        (NAMED, (1, 1, 1), {"gyro_unit": "deg/s"}, "none does in deg/s; if it is in rad/s"),
        (NAMED, (1, 1, 1), {"gyro_unit": "mdeg/s"}, "none does in mdeg/s; if it is in rad/s"),
        # One of two that are alike.
        ("t ax ay az gx gy gz", (1, 100, 1), {}, "981.* in mg or in cm/s2; give --acc-unit mg|cm/s2 or add"),
        (
            "t ax ay az gx gy gz",
            (1, 1e3 / G, 1),
            {},
            "100.*so it is in mg or in cm/s2; give --acc-unit mg|cm/s2",
        ),
        # No unit that is known.
        (
            "t ax ay az gx gy gz",
            (1, 1, 131 / DEGREE),
            {},
            r"neither in rad/s nor in deg/s.*gx_radps: \{column: gx, unit: deg/s,",
        ),
        ("t ax ay az gx gy gz", (1, 1670, 1), {}, r"raw counts.*ax_mps2: \{column: ax, factor:"),
        (NAMED, (1, 3, 1), {}, "the specific force is 29.* where the log is calm"),
        # Two columns for one.
        ("time ax accel_x az gx gy gz", (1, 1, 1), {}, "`ax` and `accel_x` may both be ax_mps2"),
        ("time stamp ay az gx gy gz", (1, 1, 1), {}, "`time` and `stamp` may both be t_s"),
    ],
)
def test_what_the_readings_contradict_is_refused_with_what_to_do(
    tmp_path: Path, names: str, factors: tuple[float, float, float], options: dict[str, str], words: str
) -> None:
    t, values = _imu()
    columns = [factors[0] * t, *(factors[1] * values[:, :3]).T, *(factors[2] * values[:, 3:]).T]
    path = _written(tmp_path / "log.csv", names.split(), columns)
    with pytest.raises(BadInputError, match=words):
        read_log(path, LogOptions(**options))  # type: ignore[arg-type]


def test_axes_without_a_unit_have_that_of_the_others(tmp_path: Path) -> None:
    """Which is not mg, though the readings would allow it."""
    t, values = _imu()
    names = ["t", "ax", "ay", "az", "gx", "gy", "gz"]
    path = _written(tmp_path / "log.csv", names, [t, *(values * np.repeat([100.0, 1.0], 3)).T])
    (tmp_path / "columns.yaml").write_text("ax_mps2: {column: ax, unit: cm/s2}\n")
    log = read_log(path)
    assert all(np.allclose(log.columns[name], values[:, k], atol=1e-4) for k, name in enumerate(AXES))


def test_stamps_in_whole_seconds_tell_no_time(tmp_path: Path) -> None:
    t, values = _imu()
    path = _written(tmp_path / "log.csv", NAMED.split(), [t // 1.0, *values.T])
    with pytest.raises(BadInputError, match=r"t_s comes in steps of 1 s, each of which 1?\d\d rows share"):
        read_log(path)


@pytest.mark.parametrize(("scale", "unit"), [(1e3, "mdeg/s"), (131.0, "")])
@pytest.mark.parametrize("moving", [True, False])
def test_millidegrees_are_read_where_the_turns_say_so(
    tmp_path: Path, scale: float, unit: str, moving: bool
) -> None:
    """Raw counts of an MPU6050 look like them: at rest they make any noise that of a good gyroscope."""
    t, values = _imu(moving)
    columns = [t, *values[:, :3].T, *np.rint(values[:, 3:] * scale / DEGREE).T]
    path = _written(tmp_path / "log.csv", ["t", "ax", "ay", "az", "gx", "gy", "gz"], columns)
    if unit and moving:
        log = read_log(path)
        assert log.map is not None and log.map.sources["gz_radps"].unit == unit
        assert np.allclose(log.columns["gz_radps"], values[:, 5], atol=1e-4)
        return
    with pytest.raises(BadInputError, match=r"neither in rad/s nor in deg/s\. Of raw counts"):
        read_log(path)


@pytest.mark.parametrize("gyro", ["deg/s", "rad/s"])
@pytest.mark.parametrize("named", [True, False])
def test_a_board_that_lies_flat_tells_the_unit_of_its_gyroscope(
    tmp_path: Path, gyro: str, named: bool
) -> None:
    """Gravity is along z, so that atan2(ay, ax) is noise."""
    t, values = _imu(moving=False)
    values = values[:, [1, 2, 0, 3, 4, 5]] + [0.0, 0.0, 0.0, 0.004, -0.003, 0.006]
    columns = [t, *values[:, :3].T, *(values[:, 3:] / (DEGREE if gyro == "deg/s" else 1.0)).T]
    names = ["t_s", *AXES] if named else ["t", "ax", "ay", "az", "gx", "gy", "gz"]
    path = _written(tmp_path / "log.csv", names, columns)
    if named and gyro == "deg/s":
        with pytest.raises(BadInputError, match="in deg/s, give --gyro-unit deg/s"):
            read_log(path)
        return
    assert np.allclose(read_log(path).columns["gz_radps"], values[:, 5], atol=1e-6)


@pytest.mark.parametrize("names", [["t_s", *AXES], ["t", "ax", "ay", "az", "gx", "gy", "gz"]])
def test_a_large_bias_at_rest_is_no_turn(tmp_path: Path, names: list[str]) -> None:
    """An MPU6050 may be off by 20 deg/s."""
    t, values = _imu(moving=False)
    values = values + np.array([0.0, 0.0, 0.0, 0.2, -0.15, 0.25])
    log = read_log(_written(tmp_path / "log.csv", names, [t, *values.T]))
    assert np.allclose(log.columns["gz_radps"], values[:, 5], atol=1e-6)


def test_a_pendulum_that_the_accelerometer_does_not_feel_is_no_loud_gyroscope(tmp_path: Path) -> None:
    """Two swings a second at 50 Hz, in which the head's acceleration is that of gravity along its path."""
    t, values = _imu(moving=False)
    t = 0.02 * np.arange(250)
    values = values[: len(t)]
    values[:, 5] += 0.5 * np.exp(-0.3 * t) * np.cos(12.6 * t)
    log = read_log(_written(tmp_path / "log.csv", ["t_s", *AXES], [t, *values.T]))
    assert np.allclose(log.columns["gz_radps"], values[:, 5], atol=1e-6)


def test_a_unit_that_a_person_states(tmp_path: Path) -> None:
    t, values = _imu()
    columns = [t, *(values[:, :3] / G).T, *(values[:, 3:] / DEGREE).T]
    path = _written(tmp_path / "log.csv", ["t_s", *AXES], columns)
    by_option = read_log(path, LogOptions("g", "deg/s"))
    (tmp_path / "log.columns.yaml").write_text("units: {accel: g, gyro: deg/s}\n")
    by_file = read_log(path)
    for log in (by_option, by_file):
        assert np.allclose(np.stack([log.columns[name] for name in AXES], axis=1), values, atol=1e-6)


@pytest.mark.parametrize("unit", ["rad/s", "deg/s"])
@pytest.mark.parametrize(
    ("arm_px", "late_s", "decided"), [(60.0, 0.05, True), (60.0, 0.0, True), (3.0, 0.0, False)]
)
def test_a_marker_that_turns_with_the_gyroscope_tells_its_unit(
    tmp_path: Path, unit: str, arm_px: float, late_s: float, decided: bool
) -> None:
    """Without an accelerometer either unit is possible; the picture is 320 px wide."""
    t = 0.01 * np.arange(1500)
    noise = np.random.default_rng(1).normal(size=(3, len(t)))
    phi = 0.1 * np.sin(2.0 * (t - late_s))
    seen = 160.0 + arm_px * phi + 0.05 * noise[0], 120.0 + 0.05 * noise[1]
    gz = -0.2 * np.cos(2.0 * t) + 0.003 * noise[2] + 0.01
    columns = [t, *seen, gz / (DEGREE if unit == "deg/s" else 1.0)]
    path = _written(tmp_path / "log.csv", ["t_s", "u", "v", "gyro_z"], columns)
    if not decided:
        with pytest.raises(BadInputError, match="cannot tell whether `gyro_z`"):
            read_log(path)
        return
    log = read_log(path)
    assert np.allclose(log.columns["gz_radps"], gz, atol=1e-6)
    assert log.map is not None and "px away from the axis" in log.map.narration


@pytest.mark.parametrize("stuck", [False, True])
def test_a_gyroscope_at_rest_that_may_be_either_is_not_guessed(tmp_path: Path, stuck: bool) -> None:
    t, values = _imu(moving=False)
    columns = [t, *values[:, :3].T, np.full(len(t), 0.00844367) if stuck else 4.0 * values[:, 5]]
    path = _written(tmp_path / "log.csv", ["t", "ax", "ay", "az", "gz"], columns)
    words = "cannot tell whether `gz` is in rad/s or in deg/s, as either is possible"
    with pytest.raises(BadInputError, match=words):
        read_log(path)
    assert len(read_log(path, LogOptions(gyro_unit="deg/s"))) == 3000


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gz_radsp: gz\n", "gz_radsp is not known; did you mean gz_radps"),
        ("gz_radps: {column: gz, unit: m}\n", "gz_radps.unit is 'm', expected one of rad/s, deg/s"),
        ("gz_radps: {col: gz}\n", "expected a column's name or column, unit, factor, offset"),
        ("gz_radps: {column: gz, factor: much}\n", "gz_radps.factor is 'much', expected a number"),
        ("units: {accel: lb}\n", "units.accel is 'lb', expected one of m/s2, g"),
        ("names: 3\n", "names is 3, expected a list"),
        ("rate_hz: 0\n", "rate_hz is 0, expected rows a second"),
        ("separator: '|'\n", "separator is '|', expected one of"),
    ],
)
def test_a_columns_file_that_is_wrong(tmp_path: Path, text: str, words: str) -> None:
    t, values = _imu()
    path = _written(tmp_path / "log.csv", ["t_s", "gz_radps"], [t, values[:, 5]])
    (tmp_path / "columns.yaml").write_text(text)
    with pytest.raises(BadInputError, match=words):
        read_log(path)


def test_a_recording_of_somebody_else(shared_data: Path) -> None:
    log = read_log(shared_data / "imufusion" / "sensor_data.csv")
    assert sorted(log.columns) == sorted(AXES)
    assert log.unknown == ("Magnetometer X (uT)", "Magnetometer Y (uT)", "Magnetometer Z (uT)")
    assert "; not read: Magnetometer X (uT), Magnetometer Y (uT), Magnetometer Z (uT)" in log.remarks()[0]
    with pytest.raises(BadInputError, match=r"has no u_px, .*`Magnetometer X \(uT\)`.* the line u_px: NAME"):
        log.signals("u_px")
    start = log.t_s < 2.0
    force = np.stack([log.columns[name][start] for name in AXES[:3]], axis=1)
    assert np.median(np.linalg.norm(force, axis=1)) == pytest.approx(G, rel=0.02)
    # The sensor turns by a third of a turn at a time, no faster than a hand.
    assert 1.0 < np.abs(log.columns["gz_radps"]).max() < 12.0


def test_parquet_has_units_too(tmp_path: Path) -> None:
    t, values = _imu()
    columns = {name: v / G if name[0] == "a" else v for name, v in zip(AXES, values.T, strict=True)}
    path = tmp_path / "log.parquet"
    write_log(path, Log("log", t, columns, np.arange(3000)))
    with pytest.raises(BadInputError, match="give --acc-unit g"):
        read_log(path)
    assert np.allclose(read_log(path, LogOptions(acc_unit="g")).columns["ax_mps2"], values[:, 0])


def test_stamps_that_never_advance_tell_no_unit_of_rates(tmp_path: Path) -> None:
    """As those of an epoch in float32, which has steps of two minutes."""
    path = tmp_path / "log.csv"
    path.write_text(
        "t_s,gz_radps,ax_mps2,ay_mps2\n"
        + "".join(f"1732784384,{0.01 * (k % 5):g},9.8,{k % 3}\n" for k in range(200))
    )
    assert len(read_log(path)) == 200
    path.write_text(path.read_text().replace("t_s", "timestamp").replace("1732784384", "1.73E+09"))
    words = "the time `timestamp` is 1730000000 in every row, expected it to advance"
    with pytest.raises(BadInputError, match=words):
        read_log(path)


def test_a_slow_swing_in_degrees_turns_too_far_to_be_in_rad(tmp_path: Path) -> None:
    """From one second to the next it turns too little to be held against the force's turns."""
    rng, t = np.random.default_rng(0), 0.01 * np.arange(3000)
    phi, rate = 0.07 * np.sin(0.6 * t), 0.07 * 0.6 * np.cos(0.6 * t)
    gz = -rate + 0.003 * rng.normal(size=len(t))
    names, force = ["t_s", "ax_mps2", "ay_mps2", "gz_radps"], [G * np.cos(phi), G * np.sin(phi)]
    assert len(read_log(_written(tmp_path / "log.csv", names, [t, *force, gz]))) == len(t)
    with pytest.raises(BadInputError, match=r"turns .* times as far as the accelerometer's angle"):
        read_log(_written(tmp_path / "log.csv", names, [t, *force, np.degrees(gz)]))


@pytest.mark.parametrize("felt", [0.0, 0.02, 0.05])
def test_a_pendulum_may_feel_no_turn_of_gravity(tmp_path: Path, felt: float) -> None:
    """An IMU at its end feels the rod's force alone, and turns by any number of times as far."""
    t, rng = 0.01 * np.arange(1200), np.random.default_rng(0)
    swing = 0.6 * np.cos(6.0 * t) * np.exp(-0.05 * t)
    rate = np.degrees(np.gradient(swing, t)) + 0.1 * rng.normal(size=len(t))
    force = np.stack([np.cos(swing), felt * swing], axis=1) + 0.003 * rng.normal(size=(len(t), 2))
    path, rows = tmp_path / "swing.csv", np.column_stack([t, force, rate])
    np.savetxt(path, rows, fmt="%.5f", delimiter=",", header="t_s,acc_x,acc_y,gyro_z", comments="")
    for said in (LogOptions(), LogOptions(gyro_unit="deg/s", acc_unit="g")):
        log = read_log(path, said)
        np.testing.assert_allclose(np.degrees(log.columns["gz_radps"]), rate, atol=1e-4)
