"""The verbs of `calib`."""

from __future__ import annotations

import sys

import typer

from calib.cli.camera import board, export_camera, import_camera
from calib.cli.common import telling
from calib.cli.convert import convert
from calib.cli.diff import diff
from calib.cli.docs import docs
from calib.cli.doctor import doctor
from calib.cli.fleet import fleet, sweep
from calib.cli.live import live
from calib.cli.record import record
from calib.cli.report import report
from calib.cli.run import run
from calib.cli.simulate import simulate
from calib.cli.track import track
from calib.cli.verbs import OneByDefault, group, verb
from calib.core import __version__
from calib.stages import stage

app = typer.Typer(
    name="calib",
    help="Calibrate a cheap camera and an IMU on a machine, down to the constants in its firmware.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(value: bool) -> None:
    if value:
        sys.stdout.write(f"calib {__version__}\n")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", help="Show the version and leave.", callback=_show_version, is_eager=True
    ),
) -> None:
    pass


app.command("run")(telling(run))
app.command("intrinsics")(verb(stage("intrinsics")))
app.command("live")(live)
app.command("extrinsics")(verb(stage("extrinsics")))
app.command("distortion")(verb(stage("distortion")))
app.command("lowpass")(verb(stage("lowpass")))
app.add_typer(group("imu", "Understand an IMU: its bias, its noise, its drift."), name="imu")
app.command("align")(telling(verb(stage("align"))))
app.command("replay")(telling(verb(stage("replay"))))
app.add_typer(
    group(
        "identify",
        "Identify the actuator from LOG..., a pump from tables, springs from weights; all with error bars.",
        OneByDefault,
    ),
    name="identify",
)
app.add_typer(
    group("control", "Try controllers on the identified model before the hardware."), name="control"
)
app.command("validate")(telling(verb(stage("validate"))))
app.command("firmware")(verb(stage("firmware")))
app.command("fleet")(telling(fleet))
app.command("sweep")(telling(sweep))
app.command("record")(record)
app.command("track")(track)
app.command("convert")(convert)
app.command("board")(board)
app.command("simulate")(telling(simulate))
app.command("export")(export_camera)
app.command("import")(import_camera)
app.command("report")(report)
app.command("diff")(diff)
app.command("doctor")(doctor)
app.command("docs")(docs)
