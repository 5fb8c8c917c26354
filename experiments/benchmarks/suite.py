"""What is measured: lists of cases, and which libraries in each."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

from experiments.benchmarks import cases, measure
from experiments.benchmarks.cases import Data, Problem
from experiments.benchmarks.measure import Case, Timing

QUANTITIES = ("likelihood", "history", "gradient")
PARTS = ("kalman", "float32", "batches", "ekf", "ukf", "imm", "linear", "programs", "long")
BATCHES = (1, 16, 256, 2048, 16384, 100_000)
MAIN = cases.KALMAN[1]
RUNS, STEPS, QUICK_RUNS = 2048, 200, 512
LARGEST_RESULT = 1e9  # bytes
LONGEST_CALL = 8.0  # [s] a library that would need more at the next batch size stops
ALL: tuple[str, ...] = ("jaxfilt", "jaxfilt full", "dynamax", "cuthbert", "kalman-py", "filterpy", "C", "C full")


class Result(NamedTuple):
    """The outcome of one case."""

    part: str
    case: Case
    timings: dict[str, Timing]
    notes: dict[str, str]


class Suite:
    """Runs cases one after the other and keeps what they gave."""

    def __init__(self, *, threads: int, quick: bool = False, budget: float = 3.0) -> None:
        """Data are made at the first use."""
        self.threads, self.quick, self.budget = threads, quick, budget
        self.results: list[Result] = []
        self.memory: dict[tuple[str, str], float] = {}  # (library, quantity) -> bytes
        self._data: dict[tuple[str, str, int], Data] = {}

    def run(self, part: str) -> None:
        """Measures one of :data:`PARTS`."""
        getattr(self, part)()

    def case(self, part: str, case: Case, names: Sequence[str], **options: float) -> Result:
        """Measures one case and says so on stderr."""
        begun = time.perf_counter()
        data = self.data(case.problem, case.dtype, case.batch, case.steps)
        timings, notes = measure.measure(case, data, names, threads=self.threads, **{"budget": self.budget, **options})  # pyright: ignore[reportArgumentType]
        shown = ", ".join(f"{name} {t.rate / 1e6:.3g}" for name, t in timings.items())
        differs = [note for note in notes.values() if "differs" in note]
        print(
            f"{part}: {case.problem.name}, {case.dtype}, {case.quantity}, {case.batch} x {case.steps}: "
            f"{shown} M steps/s ({time.perf_counter() - begun:.0f} s) {' '.join(differs)}",
            file=sys.stderr,
            flush=True,
        )
        self.results.append(Result(part, case, timings, notes))
        return self.results[-1]

    def data(self, p: Problem, dtype: str, batch: int, steps: int) -> Data:
        """Simulated data, the same for all cases of a problem."""
        key = (p.name, dtype, steps)
        kept = self._data.get(key)
        if kept is None or len(kept.log_r) < batch:
            self._data = {key: cases.simulate(p.astype(dtype), batch, steps)}  # one at a time: they are large
        return self._data[key].first(batch)

    def kalman(self) -> None:
        """Sizes from 2 to 9, and dense transitions, in float64."""
        if self.quick:
            for quantity in QUANTITIES:
                # cuthbert's gradient takes longer to compile than all others together
                names = [x for x in ALL if (x, quantity) != ("cuthbert", "gradient")]
                self.case("kalman", Case(MAIN, quantity, QUICK_RUNS), names)
            return
        for p in cases.KALMAN:
            for quantity in QUANTITIES:
                if not p.order:  # turned axes change nothing for peers: the own dense form is what counts
                    names = ["jaxfilt", "jaxfilt dense", "dynamax", "C"]
                elif quantity == "gradient" and p is not MAIN:
                    names = ["jaxfilt", "dynamax"]
                else:
                    names = [*ALL, "dynamax split"] if p is MAIN else list(ALL)
                self.case("kalman", Case(p, quantity, RUNS), names)

    def float32(self) -> None:
        """Single precision."""
        for p in (MAIN, cases.KALMAN[-1]):
            for quantity in QUANTITIES:
                self.case("float32", Case(p, quantity, RUNS, dtype="float32"), ("jaxfilt", "dynamax", "C"))

    def batches(self) -> None:
        """From one run to 100000; a library leaves where a call would take too long."""
        for dtype in ("float64", "float32"):
            for quantity in QUANTITIES:
                names = ["jaxfilt", "dynamax", "C"] + ["cuthbert"] * (dtype == "float64" and quantity == "likelihood")
                for batch in BATCHES:
                    size = 8 if dtype == "float64" else 4
                    if quantity == "history" and batch * STEPS * (MAIN.n + MAIN.n**2) * size > LARGEST_RESULT:
                        self.results.append(Result("batches", Case(MAIN, quantity, batch, STEPS, dtype), {},
                                                   dict.fromkeys(names, "result over 1 GB")))  # fmt: skip
                        continue
                    case = Case(MAIN, quantity, batch, STEPS, dtype)
                    out = self.case("batches", case, names, budget=1.0)
                    later = BATCHES[BATCHES.index(batch) + 1 :][:1]
                    for name, timing in out.timings.items():
                        if later and later[0] * STEPS / timing.rate > LONGEST_CALL:
                            names.remove(name)

    def ekf(self) -> None:
        """Range and bearing of a turning target."""
        self._nonlinear("ekf", ("jaxfilt", "dynamax", "cuthbert", "kalman-py"), QUANTITIES)

    def ukf(self) -> None:
        """Range and bearing of a straight target."""
        self._nonlinear("ukf", ("jaxfilt", "dynamax", "filterpy"), QUANTITIES)

    def imm(self) -> None:
        """Three models."""
        self._nonlinear("imm", ("jaxfilt", "filterpy"), QUANTITIES[:2])

    def _nonlinear(self, family, names, quantities):
        for quantity in quantities:
            which = names if quantity != "gradient" else ("jaxfilt", "dynamax")
            self.case(family, Case(cases.NONLINEAR[family], quantity, RUNS), which)

    def linear(self) -> None:
        """Cost against runs and steps."""
        for steps in (50, 200, 800):
            for runs in (512, 2048, 8192):
                self.case("linear", Case(MAIN, "likelihood", runs, steps), ["jaxfilt"], budget=1.0)

    def programs(self) -> None:
        """Memory of the compiled programs."""
        data = self.data(MAIN, "float64", RUNS, STEPS)
        for quantity in QUANTITIES:
            for name in ("jaxfilt", "dynamax", "cuthbert", "kalman-py"):
                if name in ("cuthbert", "kalman-py") and quantity == "gradient":
                    continue
                try:
                    self.memory[name, quantity] = measure.memory(Case(MAIN, quantity, RUNS), data, name)
                except ImportError:
                    continue

    def long(self) -> None:
        """One run of 100000 steps."""
        for quantity in ("likelihood", "history"):
            self.case("long", Case(MAIN, quantity, 1, 100_000), ["jaxfilt one", "dynamax one"])
