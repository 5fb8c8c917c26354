"""The command line: ``python -m jaxfilt track FILE.csv`` and ``python -m jaxfilt compare FILE.csv``."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from typing import NoReturn

import jax

from jaxfilt._version import __version__
from jaxfilt.cli.filters import FILTERS, MODELS, PARAMETERS, UNITS
from jaxfilt.cli.read import Options
from jaxfilt.cli.units import BadInput, quantity
from jaxfilt.progress import everywhere

_EXAMPLES = """
examples:
  python -m jaxfilt track flight.csv --out track.html --out track.csv
  python -m jaxfilt track flight.csv --model ct --filter imm --smooth --out track.png
  python -m jaxfilt track radar.csv --time ms:ms --range-bearing r:km,az:deg --compass --model cv --filter unscented
  python -m jaxfilt track ais.csv --where vessel=3 --lat-lon lat,lon --set sigma=10m
  python -m jaxfilt compare flight.csv --filters cv,ca,ct:unscented,ct:imm --hide 10 --out scores.csv

columns are found by their names (t, time, timestamp; x, y, z; east, north, up; lat, lon, alt; range, bearing), with the
unit in the header (x_km, "x [km]") or after a colon (--position x:km,y:km); otherwise m, s, deg. Empty cells are
missing. What was assumed is printed first.
"""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise BadInput(message)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        argv: the arguments; None = those of the process.

    Returns:
        The exit status: 0, or 2 after one line on the standard error that says what is wrong.
    """
    try:
        args = _parser().parse_args(argv)
        # The library leaves precision to its user. Here this program is the user.
        jax.config.update("jax_enable_x64", True)
        options = Options(
            time=args.time, position=args.position, lat_lon=args.lat_lon, range_bearing=args.range_bearing,
            interval=None if args.interval is None else _positive(args.interval, "--interval"),
            compass=args.compass, where=args.where, duplicates=args.duplicates,
        )  # fmt: skip
        for name, least in (("steps", 1), ("learn_rows", 40)):
            if getattr(args, name) < least:
                raise BadInput(f"--{name.replace('_', '-')}: expected {least} or more, got {getattr(args, name)}")
        # plotly, matplotlib and pandas are imported where they are needed
        with everywhere() if find_spec("tqdm") else contextlib.nullcontext():
            if args.command == "track":
                from jaxfilt.cli.track import track

                track(args, options)
            else:
                from jaxfilt.cli.compare import compare

                compare(args, options)
    except (BadInput, ImportError, OSError) as error:
        print(f"jaxfilt: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxfilt: interrupted", file=sys.stderr)
        return 130
    return 0


def _positive(text: str, what: str) -> float:
    value = quantity(text, "time", what)
    if not value > 0:
        raise BadInput(f"{what}: expected a time above 0, got {text}")
    return value


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = _Parser(
        prog="jaxfilt", description="State estimation from a CSV file of positions.", epilog=_EXAMPLES,
        formatter_class=raw,
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"jaxfilt {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="{track,compare}", parser_class=_Parser)
    names = "\n".join(
        f"  {name:<14} {UNITS.get(kind, kind):<10} {meaning}"
        for name, (kind, meaning) in PARAMETERS.items()
        if not name.startswith(("q", "sigma_a")) or not name.endswith("_z")
    )
    models = "\n".join(f"  {name:<14} {meaning}" for name, meaning in MODELS.items())
    epilog = f"models:\n{models}\n\nparameters, with _z behind q and sigma for a third axis:\n{names}\n{_EXAMPLES}"

    track = commands.add_parser("track", help="one filter over a file", epilog=epilog, formatter_class=raw)
    track.add_argument("--model", default="cv", help="of the motion; several with + make an IMM, as cv+ca+ct (cv)")
    track.add_argument(
        "--filter",
        metavar="FILTER",
        help=f"{', '.join(FILTERS)}; unless named, the simplest for the model and the sensor",
    )
    track.add_argument("--smooth", action="store_true", help="estimates from the whole file, not from its past only")
    compare = commands.add_parser("compare", help="several filters on a file", epilog=epilog, formatter_class=raw)
    compare.add_argument("--filters", required=True, metavar="MODEL[:FILTER],...", help="as cv:kalman,ca,ct:imm")
    compare.add_argument("--train-share", type=float, default=0.6, help="part of the rows that is learnt from (0.6)")
    compare.add_argument("--hide", type=int, default=5, metavar="ROWS", help="length of the gaps that are bridged (5)")
    for command in (track, compare):
        command.add_argument("file", metavar="FILE.csv")
        command.add_argument("--out", action="append", default=[], metavar="FILE", help="csv, png or html; repeatable")
        command.add_argument("--set", action="append", default=[], metavar="NAME=VALUE",
                             help="a parameter, with its unit: sigma=5m; what is not set is learnt")  # fmt: skip
        columns = command.add_argument_group("columns")
        columns.add_argument("--time", metavar="NAME[:UNIT]", help="in s, ms, us, ns, min, h, or ISO time stamps")
        columns.add_argument("--interval", metavar="TIME", help="of rows without time stamps, as 0.1s")
        columns.add_argument("--position", metavar="X[:UNIT],Y,Z", help="one to three columns; m, km, ft, nmi, ...")
        columns.add_argument("--lat-lon", metavar="LAT,LON[,ALT]", help="put into a plane of meters east and north")
        columns.add_argument("--range-bearing", metavar="R:UNIT,B:UNIT", help="seen from the origin")
        columns.add_argument("--compass", action="store_true", help="bearings are clockwise from north")
        columns.add_argument("--where", action="append", default=[], metavar="COLUMN=VALUE", help="only these rows")
        columns.add_argument("--duplicates", default="error", metavar="{error,first,both}",
                             help="rows with the time stamp of the row before (error)")  # fmt: skip
        learning = command.add_argument_group("learning")
        learning.add_argument("--learn-rows", type=int, default=1000, metavar="ROWS",
                              help="rows to learn from; of a longer file four stretches (1000)")  # fmt: skip
        learning.add_argument("--steps", type=int, default=80, help="of the gradient descent (80)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
