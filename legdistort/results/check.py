"""What is checked of a result: a question, the answer, and a cure."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite

from scipy import special

from ..runtime.notebook import Column, Fact, Grid, ShownAsPrinted
from ..runtime.trees.facts import number, text

#: Probability with which a check warns of a set in which nothing is wrong; all of them together make 2 %.
FALSE_ALARM = 1e-3
#: What is less probable than this is beyond doubt: "fail", where it is also large enough to matter.
CERTAIN = 1e-6
#: From best to worst; "unknown" is a question that the data cannot answer.
STATES = ("pass", "unknown", "warn", "fail")
#: ... of which these are of something wrong.
WRONG = STATES[2:]


@dataclass(frozen=True)
class FactorTest:
    """What was known beforehand, against what everything else shows of the same.

    Attributes
    ----------
    name : str
        "static distortion", "reference: positions", "reference: map", "layout" and so on.
    source : str
        From where it was known.
    rows : int
        Numbers that were known.
    chi2, dof : float
        Of the difference of both, under the sum of their covariances, where everything else determines it.
    p : float
        Probability of so large a difference by chance; 1 without degrees of freedom.
    """

    name: str
    source: str
    rows: int = field(metadata=number(minimum=0))
    chi2: float = field(metadata=number(minimum=0))
    dof: float = field(metadata=number(minimum=0))
    p: float = field(metadata=number(minimum=0, maximum=1))

    @classmethod
    def of_chi2(cls, name: str, source: str, rows: int, chi2: float, dof: float) -> FactorTest:
        """With the probability that chi2 has."""
        p = float(special.chdtrc(dof, chi2)) if dof > 0 else 1.0
        return cls(name, source, int(rows), float(chi2), float(dof), p)


@dataclass(frozen=True)
class Check(ShownAsPrinted):
    """One check of a result.

    Attributes
    ----------
    name : str
        Stable: "chi2", "time", "place" and so on.
    state : {"pass", "unknown", "warn", "fail"}
    value, limit : float or None
        What was found, and beyond what the state is no longer "pass"; what they measure is in the sentence.
    sentence : str
        What was found, in words.
    cure : str
        What to do about it; empty for a pass.
    tests : tuple of FactorTest
        Of what was known beforehand, where the check is of that.
    exposures : tuple of str
        Those whose maps it is of; empty for all.
    """

    name: str
    state: str = field(metadata=text(*STATES))
    value: float | None
    limit: float | None
    sentence: str
    cure: str = ""
    tests: tuple[FactorTest, ...] = ()
    exposures: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("value", "limit"):
            number = getattr(self, name)
            if number is not None:  # plain numbers, as files and JSON have them
                object.__setattr__(self, name, float(number) if isfinite(number) else None)

    def doubts(self, names: set[str]) -> bool:
        """Whether maps of some of these exposures may be off: it fails, or maps are hardly determined."""
        wrong = self.state == "fail" or (self.name == "extrapolation" and self.state in WRONG)
        return wrong and not (self.exposures and names.isdisjoint(self.exposures))

    @property
    def _words(self) -> str:
        """What was found, and what to do about it."""
        return f"{self.sentence}{'; ' * bool(self.cure)}{self.cure}"

    def __str__(self) -> str:
        return f"{self.state:7s} {self.name}: {self._words}"

    def _parts(self):
        return Checks([self])._parts()


class Checks(tuple[Check, ...], ShownAsPrinted):
    """Checks of a result: a tuple, which a notebook shows as a table, the worst first."""

    __slots__ = ()

    def _parts(self):
        rows = _worst_first(self)
        columns = {"check": "name", "state": "state", "what was found": "sentence", "what to do": "cure"}
        shown = [Column(head, [getattr(c, key) for c in rows], words=True) for head, key in columns.items()]
        return [Grid(shown if any(c.cure for c in rows) else shown[:-1])]


def state_of(p, matters=True):
    """State of a check whose finding has the probability p by chance, and may be large enough to matter."""
    return "pass" if p > FALSE_ALARM else "fail" if p < CERTAIN and matters else "warn"


def worst(checks):
    """The worst state of some checks; "pass" without any."""
    return max((check.state for check in checks), key=STATES.index, default="pass")


def in_facts(checks):
    """A `Fact` of what passes, and one for each check that does not, the worst first."""
    passed = [c.name for c in checks if c.state == "pass"]
    first = Fact("checks", f"{len(passed)} of {len(checks)} pass" + (f": {', '.join(passed)}" if passed else ""))
    return [first, *(Fact(c.state, f"{c.name}: {c._words}") for c in _worst_first(checks) if c.state != "pass")]


def _worst_first(checks):
    return sorted(checks, key=lambda check: -STATES.index(check.state))
