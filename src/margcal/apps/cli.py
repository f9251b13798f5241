"""The command line: a verb each, read with click. What a verb does is imported when it is called.

Exit status: 0 done, 1 the input cannot be read or understood, 2 usage, 3 the data cannot carry what was asked,
130 interrupted. An error is one line on stderr; there is never a traceback (MARGCAL_DEBUG=1 shows one).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import click

Verb = TypeVar("Verb", bound=Callable[..., Any])

INTERRUPTED = 130


# --- options that several verbs share -----------------------------------------------------------------


def _units(_context: click.Context, _parameter: click.Parameter, text: str | None) -> dict[str, str] | None:
    """``acc=count,gyr=dps`` as a dict."""
    if text is None:
        return None
    units: dict[str, str] = {}
    for part in text.split(","):
        kind, sign, unit = (p.strip() for p in part.partition("="))
        if not (kind and sign and unit) or kind in units:
            raise click.BadParameter(f"{part!r} is not SENSOR=UNIT; expected such as acc=count,gyr=dps")
        units[kind] = unit
    return units


def _numbers(context: click.Context, parameter: click.Parameter, text: str | None) -> dict[str, float] | None:
    """``acc=0.0048,gyr=0.001`` as a dict of positive numbers."""
    numbers: dict[str, float] = {}
    for kind, value in (_units(context, parameter, text) or {}).items():
        try:
            numbers[kind] = float(value)
        except ValueError:
            numbers[kind] = 0.0
        if not 0 < numbers[kind] < float("inf"):
            raise click.BadParameter(f"{value!r} is no scale; expected such as acc=0.00479")
    return numbers or None


def _together(*options: Callable[[Verb], Verb]) -> Callable[[Verb], Verb]:
    def decorate(verb: Verb) -> Verb:
        for option in reversed(options):
            verb = option(verb)
        return verb

    return decorate


_units_option = click.option(
    "--units",
    metavar="acc=count,...",
    callback=_units,
    help="Units of sensor columns whose names carry none.",
)
_reading = _together(
    _units_option,
    click.option("--rate", type=float, metavar="HZ", help="Take time from the row number instead of t_s."),
    click.option("--sort", is_flag=True, help="Sort rows whose time runs backwards."),
    click.option(
        "--skip-bad",
        type=click.IntRange(min=0),
        default=0,
        metavar="N",
        help="Skip up to N unreadable rows of a text table.",
    ),
    click.option("--max-bytes", type=click.IntRange(min=1), metavar="N", help="Read larger files than 2 GB."),
)
_json = click.option("--json", "as_json", is_flag=True, help="Machine-readable result on stdout, nothing else.")
_overwrite = click.option("--overwrite", is_flag=True, help="Replace results that exist.")
_at = click.option("--at", metavar="LAT,LON[,DATE]", help="Place and date, for gravity and magnetic field.")
_sensors = click.option("--sensors", metavar="acc,gyr,mag", help="Only these.")


def _how_to_read(given: dict[str, Any]) -> dict[str, Any]:
    """The options of `_reading`, taken out of `given`."""
    reading = {name: given.pop(name) for name in ("units", "rate", "sort", "skip_bad", "max_bytes")}
    return {k: v for k, v in reading.items() if v is not None}


def _output(name: str, required: bool, text: str) -> Callable[[Verb], Verb]:
    return click.option("-o", "--output", metavar=name, required=required, help=text)


# --- verbs --------------------------------------------------------------------------------------------


def _print_version(context: click.Context, _parameter: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from importlib.metadata import version

        from margcal.core import compiled

        click.echo(f"margcal {version('margcal')}\ncompiled kernels: {compiled.state()}")
        context.exit()


class _Verbs(click.Group):
    """Verbs in the order in which people meet them; Ctrl-C ends any of them in one line."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            _complain("interrupted; nothing was left half written")
            return INTERRUPTED


@click.group(cls=_Verbs, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version, help="Show the version."
)
def cli() -> None:
    """Calibrate inertial and magnetic sensor nodes: raw readings in, SI units in one frame out.

    A node is put down in ten to thirty attitudes, two seconds or more each, and turned between them. `margcal demo`
    shows all of it on a simulated node.
    """


@cli.command()
@click.option("-o", "--output", metavar="DIR", default="margcal-demo", show_default=True, help="Where the files go.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Another node, another motion.")
@_overwrite
@_json
def demo(**given: Any) -> int:
    """Simulate a node, calibrate it, and show truth beside estimate."""
    from margcal.apps.demo import run

    return run(**given)


@cli.command()
@click.argument("recordings", nargs=-1, required=True, metavar="RECORDING...")
@_at
@click.option("--up", metavar="AXIS", help="Side of the node that was up at the start, such as +z or -x.")
@_reading
@_json
def check(recordings: tuple[str, ...], **given: Any) -> int:
    """Say what recordings can be used for, before anything is fitted.

    Units, saturation, clocks, rests, coverage, axes that are swapped or mirrored, delays, what is missing.
    """
    from margcal.apps.checking import run

    reading = _how_to_read(given)
    return run(recordings, reading=reading, **given)


@cli.command()
@click.argument("recordings", nargs=-1, required=True, metavar="RECORDING...")
@_output("POSES.csv", False, "Write the rests as a table that becomes a poses file.")
@_reading
@_overwrite
@_json
def segment(recordings: tuple[str, ...], **given: Any) -> int:
    """Find the rests (one second or longer) and the turns between them."""
    from margcal.apps.segmenting import run

    reading = _how_to_read(given)
    return run(recordings, reading=reading, **given)


@cli.command()
@click.argument("recordings", nargs=-1, required=True, metavar="RECORDING...")
@click.option(
    "--poses",
    default="auto",
    show_default=True,
    metavar="auto|cube|faces|free|reference|swing|FILE",
    help="How the housing lay at the rests, or a table that says so.",
)
@_sensors
@click.option(
    "--method",
    metavar="NAME[,NAME]",
    help="Accelerometer and magnetometer: gls-ml (default), one-step, alternation, eigen, svd, ellipsoid, triangular; "
    "gyroscope: gauss-newton (default), ukf.",
)
@click.option("--gravity", type=float, metavar="G", help="Local gravity, m/s^2.  [default: 9.80665]")
@click.option("--field", type=float, metavar="uT", help="Strength of the magnetic field.  [default: the unit]")
@_at
@click.option("--level", is_flag=True, help='"Up" of quaternion attitudes is up (a level table).')
@click.option(
    "--level-sd", type=float, default=1.0, show_default=True, metavar="DEG", help="Tilt of the table, one sd."
)
@click.option("--nominal", metavar="FILE", help="A calibration file with nominal models: signs and start.")
@click.option("--device", metavar="NAME", help="Name of the node, kept in the file.")
@_output("CAL.json", False, "Write the calibration file.")
@click.option("--report", metavar="REPORT.html", help="Write a report, one HTML file.")
@click.option("--allow-fail", is_flag=True, help="Write the calibration even where it failed.")
@_reading
@_overwrite
@_json
def calibrate(recordings: tuple[str, ...], level_sd: float, **given: Any) -> int:
    """Calibrate a node from one or several recordings of it.

    A recording is a table (CSV or Parquet) with columns t_s, acc_x_count, gyr_x_dps, mag_x_uT ..., or a folder of
    such tables. Without -o the result is shown only.
    """
    from margcal.apps.calibrating import run

    reading = _how_to_read(given)
    options = {name: given.pop(name) for name in ("method", "gravity", "field", "level", "device")}
    return run(recordings, reading=reading, options={**options, "level_sd_deg": level_sd}, **given)


@cli.command()
@click.argument("recording", metavar="RECORDING")
@click.option(
    "--reference", required=True, metavar="REF", help="Attitudes from motion capture; may be RECORDING itself."
)
@click.option("--static", metavar="STATIC", help="A recording of the node at rest, for the gyroscope's bias.")
@click.option("--common-clock", is_flag=True, help="REF is on the node's clock (always so if it is RECORDING).")
@click.option("--markers", metavar="NAME,...", help="Markers of the body, where REF holds marker tracks (C3D, table).")
@click.option(
    "--marker-unit",
    type=click.Choice(["m", "cm", "mm", "in"]),
    help="Unit of length of a C3D file or marker table that names none.",
)
@click.option(
    "--method",
    type=click.Choice(["r-bsn", "lowpass-svd", "forward"]),
    help="The paper's; without positions; with positions.  [default: by what REF holds]",
)
@click.option("--as-printed", is_flag=True, help="R-BSN (14) as printed, to see what it gives.")
@click.option(
    "--norm",
    type=click.Choice(["l1", "lengths"]),
    default="l1",
    show_default=True,
    help="Of R-BSN (20): entrywise, or the sum of lengths.",
)
@_sensors
@click.option("--gravity", type=float, metavar="G", help="Local gravity, m/s^2.  [default: 9.80665]")
@click.option("--field", type=float, metavar="uT", help="Strength of the magnetic field.  [default: the unit]")
@_at
@click.option("--device", metavar="NAME", help="Name of the node, kept in the file.")
@_output("CAL.json", False, "Write the calibration file.")
@click.option("--report", metavar="REPORT.html", help="Write a report, one HTML file.")
@click.option("--allow-fail", is_flag=True, help="Write the calibration even where it failed.")
@_reading
@_overwrite
@_json
def align(recording: str, **given: Any) -> int:
    """Calibrate a node against motion capture of the body that it is fixed to.

    REF is a table with ref_qw ref_qx ref_qy ref_qz (body to laboratory, scalar first) and perhaps ref_p_x_m ..., marker
    tracks, or a C3D file, on a clock of its own. Clock offset and drift, the delay of each sensor, the frames, the
    lever arm, and B and H of every sensor come out at one go.
    """
    from margcal.apps.aligning import run

    reading = _how_to_read(given)
    names = ("method", "as_printed", "norm", "gravity", "field", "device")
    options = {name: given.pop(name) for name in names}
    return run(recording, reading=reading, options=options, **given)


@cli.command()
@click.argument("recordings", nargs=-1, metavar="[RECORDING]...")
@click.option("--box", "hands", flag_value="box", default=None, help="A box that is put down on its faces (default).")
@click.option("--free", "hands", flag_value="free", help="A node that is held or propped up in any attitude.")
@click.option("-n", "number", type=int, metavar="N", help="Attitudes.  [default: 18, after recordings 6]")
@_sensors
@_at
@_output("PLAN.svg", False, "Draw the attitudes.")
@_reading
@_overwrite
@_json
def plan(recordings: tuple[str, ...], **given: Any) -> int:
    """Say which attitudes to record, or after recordings which to add.

    Without a recording: a first session. With recordings: they are calibrated, and the attitudes that lower the
    expected error most are listed.
    """
    from margcal.apps.planning import run

    reading = _how_to_read(given)
    return run(recordings, reading=reading, **given)


@cli.command()
@click.argument("calibration", metavar="CAL.json")
@click.argument("recording", metavar="RECORDING")
@_output("OUT", True, "A table (.csv, .parquet), or a folder where RECORDING is one.")
@_units_option
@click.option("--force", is_flag=True, help="Apply to readings in another unit than the calibration takes.")
@_overwrite
@_json
def apply(calibration: str, recording: str, **given: Any) -> int:
    """Turn a recording into SI units."""
    from margcal.apps.applying import run

    return run(calibration, recording, **given)


@cli.command()
@click.argument("recording", metavar="RECORDING")
@click.option("--calibration", metavar="CAL.json", help="The node's calibration; without it units must be known.")
@click.option(
    "--filter",
    default="vector-selection",
    show_default=True,
    metavar="NAME",
    help="vector-selection, ekf-quest, gyro, vqf, vqf-offline.",
)
@click.option(
    "--frame", type=click.Choice(["enu", "ned", "nwu"]), default="enu", show_default=True, help="Earth frame."
)
@click.option(
    "--delays",
    type=click.Choice(["file", "estimate", "none"]),
    default="file",
    show_default=True,
    help="Correct the delays of the calibration; or tell the magnetometer's from the motion; or none.",
)
@click.option("--no-mag", is_flag=True, help="Leave the magnetometer out: relative heading.")
@click.option("--start", metavar="W,X,Y,Z", help="Attitude at the start.  [default: from the first readings]")
@click.option(
    "--gyro-bias",
    type=click.Choice(["rest", "none"]),
    default="rest",
    show_default=True,
    help="Subtract the gyroscope's mean over rests (vqf finds its own).",
)
@_output("OUT", True, "A table (.csv, .parquet): t_s qw qx qy qz.")
@_reading
@_overwrite
@_json
def orient(recording: str, **given: Any) -> int:
    """Follow the attitude of a node through a recording: t_s qw qx qy qz, node to earth."""
    from margcal.apps.orienting import run

    reading = _how_to_read(given)
    return run(recording, reading=reading, **given)


@cli.command()
@click.argument("estimate", metavar="ESTIMATE")
@click.argument("reference", metavar="REFERENCE")
@click.option(
    "--align-frames",
    type=click.Choice(["none", "yaw", "full"]),
    default="none",
    show_default=True,
    help="Turn the estimate before it is judged: about the vertical, or laboratory and body.",
)
@click.option("--align-time", is_flag=True, help="Move the estimate to where the angular speeds agree best.")
@click.option("--all-samples", is_flag=True, help="Count those too in which the column movement is 0.")
@_output("DIR", False, "Figures (JSON), errors (CSV) and a picture into this folder; PICTURE.svg: that only.")
@_overwrite
@_json
def evaluate(estimate: str, reference: str, **given: Any) -> int:
    """Say how good an estimate of attitude is, against a reference.

    ESTIMATE is a table with t_s qw qx qy qz, REFERENCE a table or folder with ref_qw ... or qw ..., both of them body
    to earth. Nothing is aligned unless asked.
    """
    from margcal.apps.evaluating import run

    return run(estimate, reference, **given)


@cli.command()
@click.argument("calibration", metavar="CAL.json")
@click.argument("recordings", nargs=-1, metavar="[RECORDING]...")
@_output("REPORT.html", True, "One HTML file that opens offline.")
@_reading
@_overwrite
@_json
def report(calibration: str, recordings: tuple[str, ...], **given: Any) -> int:
    """Show a calibration, and what it leaves over at the rests of recordings."""
    from margcal.apps.reporting import run

    reading = _how_to_read(given)
    return run(calibration, recordings, reading=reading, **given)


@cli.command()
@click.argument("calibrations", nargs=-1, required=True, metavar="CAL.json CAL.json...")
@_output("DIR", False, "Tables (JSON, CSV) and pictures (SVG) into this folder.")
@_overwrite
@_json
def compare(calibrations: tuple[str, ...], **given: Any) -> int:
    """Hold several calibrations of one node against each other: how well do B, H and converted readings agree?"""
    from margcal.apps.comparing import run

    return run(calibrations, **given)


@cli.command()
@_output("DIR", True, "Where session.parquet, poses.csv or reference.parquet, and truth.json go.")
@click.option("--n-poses", type=int, metavar="N", help="Rests.  [default: 24]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--node-seed", type=click.IntRange(min=0), help="Seed of the node alone: several recordings of one node.")
@click.option(
    "--poses", type=click.Choice(["cube", "free", "faces", "swing", "mocap"]), default="cube", show_default=True
)
@_sensors
@_at
@click.option("--rate", type=float, metavar="HZ", help="Samples per second.  [default: 100]")
@click.option("--rest-s", type=float, metavar="S", help="Length of a rest.  [default: 5]")
@click.option("--turn-s", type=float, metavar="S", help="Length of a turn.  [default: 1.5]")
@click.option("--duration-s", type=float, metavar="S", help="Length of a swing, or in front of cameras.  [default: 60]")
@click.option("--housing-sd-deg", type=float, metavar="DEG", help="Error of the housing's attitudes.  [default: 0.2]")
@click.option("--level-sd-deg", type=float, metavar="DEG", help="Tilt of the table.  [default: 0]")
@click.option("--noise", type=float, metavar="FACTOR", help="On the sensor noise.  [default: 1]")
@click.option("--knocks", type=int, metavar="N", help="Knocks inside rests.  [default: 0]")
@click.option("--mag-board", "board", is_flag=True, help="Magnetometer axes swapped and flipped, as on common boards.")
@click.option("--reference", is_flag=True, help="Add reference attitudes (ref_qw ...).")
@click.option("--separate-clocks", is_flag=True, help="A table a sensor, each with a clock and rate of its own.")
@_overwrite
@_json
def simulate(duration_s: float | None, **given: Any) -> int:
    """Write a recording of a node that does not exist, with the truth beside it.

    It lies in attitudes, is swung about, or is moved in front of cameras on another clock (--poses mocap).
    """
    from margcal.apps.simulating import run, run_mocap

    only_rests = ("n_poses", "rest_s", "turn_s", "housing_sd_deg", "level_sd_deg", "knocks", "reference")
    rests = {name: given.pop(name) for name in only_rests}
    node = {name: given.pop(name) for name in ("seed", "node_seed", "rate", "noise", "separate_clocks")}
    poses = given["poses"]
    if poses in ("swing", "mocap"):
        if wrong := [k for k, v in rests.items() if v]:
            raise click.UsageError(f"--{wrong[0].replace('_', '-')} is for rests; --poses {poses} has none")
        node["duration_s"] = duration_s
    elif duration_s is not None:
        raise click.UsageError("--duration-s is for --poses swing and mocap")
    if poses == "mocap":
        if node.pop("separate_clocks") or given.pop("at") or given.pop("board"):
            raise click.UsageError("--poses mocap takes neither --separate-clocks, --at nor --mag-board")
        del given["poses"]
        return run_mocap(**node, **given)
    return run(rests=rests, node=node, **given)


@cli.command()
@click.argument("calibration", metavar="CAL.json", required=False)
@click.option("--to", metavar="TARGET", help="Kind of file; --list shows all.")
@_output("FILE", False, "The file.")
@click.option("--list", "list_targets", is_flag=True, help="Show the targets and what each of them carries.")
@_sensors
@click.option(
    "--scale",
    metavar="acc=0.0048,...",
    callback=_numbers,
    help="What the target's driver makes of a raw count: m/s^2, rad/s, uT.",
)
@click.option("--field", type=click.FloatRange(min=1), metavar="uT", help="Strength of the field, if it is the unit.")
@click.option(
    "--max-loss",
    type=click.FloatRange(min=0),
    default=0.5,
    show_default=True,
    metavar="DEG",
    help="Direction error that leaving numbers out may cost, rms.",
)
@click.option("--allow-lossy", is_flag=True, help="Write it whatever is lost or out of the target's range.")
@click.option("--move-frame", is_flag=True, help="Turn the frame so that all of H fits (kalibr, basalt).")
@click.option("--check", is_flag=True, help="Read the file back, compile it, and compute test vectors with it.")
@_overwrite
@_json
def export(calibration: str | None, **given: Any) -> int:
    """Write a calibration as C code, or in the file of another program.

    What the target cannot hold is named with the direction error that it costs, and refused above --max-loss.
    """
    from margcal.apps.exporting import run_export

    return run_export(calibration, **given)


@cli.command(name="import")
@click.argument("file", metavar="FILE")
@click.option("--from", "source", metavar="SOURCE", required=True, help="Kind of file: see margcal export --list.")
@_output("CAL.json", True, "The calibration file.")
@click.option("--sensors", metavar="acc,gyr,mag", help="Which sensor FILE is of if it does not say; or only these.")
@click.option(
    "--units", metavar="acc=count,...", callback=_units, help="Units of the raw readings, if FILE does not say."
)
@click.option(
    "--unit", metavar="mag=uT,...", callback=_units, help="Units of the calibrated vector, if FILE does not say."
)
@click.option(
    "--scale",
    metavar="acc=0.0048,...",
    callback=_numbers,
    help="What the other program's driver makes of a raw count; the calibration then takes counts.",
)
@click.option("--device", metavar="NAME", help="Name of the node, kept in the file.")
@click.option("--frame", metavar="NAME", help="Frame of the calibrated vector, where FILE does not say it.")
@_overwrite
@_json
def import_(file: str, **given: Any) -> int:
    """Read another program's calibration file."""
    from margcal.apps.exporting import run_import

    return run_import(file, **given)


@cli.command()
@click.argument("calibration", metavar="CAL.json")
@click.argument("recording", metavar="RECORDING")
@click.option("--raw", metavar="RAW", help="The raw recording that RECORDING was made from: the answer is exact.")
@_reading
@_json
def verify(calibration: str, recording: str, **given: Any) -> int:
    """Say whether a recording that was calibrated elsewhere used this calibration the right way.

    Names the usual mistakes: sign of the bias, transposed H, forward matrix, bias subtracted after H, wrong unit,
    swapped axes. Raw columns beside the calibrated ones are used as --raw is. Without raw readings, four rests or more
    are needed.
    """
    from margcal.apps.verifying import run

    reading = _how_to_read(given)
    return run(calibration, recording, reading=reading, **given)


@cli.command()
@click.argument("paper", type=click.Choice(["z-tie", "zy-tbme", "r-bsn", "effect"]))
@click.option("--runs", type=click.IntRange(min=2), help="Of each simulation.  [default: 1000; r-bsn 10, effect 2]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@_output("DIR", False, "Tables (JSON, CSV) and figures (SVG) into this folder.")
@_overwrite
@_json
def reproduce(paper: str, **given: Any) -> int:
    """Print a paper's tables beside ours.

    z-tie and zy-tbme are the two that the solvers come from, r-bsn is the alignment with motion capture.
    effect says what each part of a calibration is worth for orientation, on public recordings (MARGCAL_DATA).
    """
    from margcal.apps.papers.reproduce import run

    return run(paper, **given)


# --- running ------------------------------------------------------------------------------------------


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the command: run, and leave with the exit status."""
    # the matrices are small: more BLAS threads only wait for each other (ten times slower on a busy machine)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    status = run(sys.argv[1:] if arguments is None else arguments)
    if status == INTERRUPTED:
        # CPython forgets that an interrupt was handled if it struck within an exec() (any dataclass being made), and
        # would end by SIGINT instead of with our status
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def run(arguments: list[str]) -> int:
    """The exit status of ``margcal ARGUMENTS``."""
    debug = os.environ.get("MARGCAL_DEBUG") == "1"
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # type: ignore[union-attr]
    try:
        status = cli.main(arguments, prog_name="margcal", standalone_mode=False)
        return status if isinstance(status, int) else 0
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return 2
    except click.ClickException as error:
        verb = error.ctx.command_path if isinstance(error, click.UsageError) and error.ctx else "margcal"
        _complain(f"{error.format_message()} (see {verb} --help)")
        return 2
    except (click.Abort, KeyboardInterrupt):
        _complain("interrupted; nothing was left half written")
        return INTERRUPTED
    except Exception as error:
        if debug:
            raise
        return _explain(error)


def _explain(error: Exception) -> int:
    """One line for `error`, and its exit status."""
    from margcal.core.errors import MargcalError

    if isinstance(error, MargcalError):
        _complain(str(error))
        return error.exit_status
    if isinstance(error, MemoryError):
        _complain("out of memory; cut the recording into parts")
    elif isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        _complain(f"{where}{error.strerror or error}")
    else:
        _complain(f"internal error, {type(error).__name__}: {error}; please report it with what MARGCAL_DEBUG=1 shows")
    return 1


def _complain(text: str) -> None:
    from margcal.apps.screen import error

    error(text)


if __name__ == "__main__":
    main()
