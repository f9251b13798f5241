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

        click.echo(f"margcal {version('margcal')}")
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
@_output("DIR", True, "Where session.parquet, poses.csv and truth.json go.")
@click.option("--n-poses", type=int, metavar="N", help="Rests.  [default: 24]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--node-seed", type=click.IntRange(min=0), help="Seed of the node alone: several recordings of one node.")
@click.option("--poses", type=click.Choice(["cube", "free", "faces", "swing"]), default="cube", show_default=True)
@_sensors
@_at
@click.option("--rate", type=float, metavar="HZ", help="Samples per second.  [default: 100]")
@click.option("--rest-s", type=float, metavar="S", help="Length of a rest.  [default: 5]")
@click.option("--turn-s", type=float, metavar="S", help="Length of a turn.  [default: 1.5]")
@click.option("--duration-s", type=float, metavar="S", help="Length of a swing.  [default: 60]")
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
    """Write a recording of a node that does not exist, with the truth beside it."""
    from margcal.apps.simulating import run

    only_rests = ("n_poses", "rest_s", "turn_s", "housing_sd_deg", "level_sd_deg", "knocks", "reference")
    rests = {name: given.pop(name) for name in only_rests}
    node = {name: given.pop(name) for name in ("seed", "node_seed", "rate", "noise", "separate_clocks")}
    if given["poses"] == "swing":
        wrong = [k for k, v in rests.items() if v]
        if wrong:
            raise click.UsageError(f"--{wrong[0].replace('_', '-')} is for rests; --poses swing has none")
        node["duration_s"] = duration_s
    elif duration_s is not None:
        raise click.UsageError("--duration-s is for --poses swing")
    return run(rests=rests, node=node, **given)


@cli.command()
@click.argument("paper", type=click.Choice(["z-tie", "zy-tbme"]))
@click.option("--runs", type=click.IntRange(min=2), default=1000, show_default=True, help="Of each simulation.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@_output("DIR", False, "Tables (JSON, CSV) and figures (SVG) into this folder.")
@_overwrite
@_json
def reproduce(paper: str, **given: Any) -> int:
    """Print a paper's tables beside ours: z-tie and zy-tbme are the two that the solvers come from."""
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
