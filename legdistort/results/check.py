"""What is checked of a result: a question, the answer, and a cure."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field
from math import isfinite

from ..runtime.notebook import ShownAsPrinted
from ..runtime.trees.facts import text

#: Probability with which a check warns of a set in which nothing is wrong; all of them together make 2 %.
FALSE_ALARM = 1e-3
#: What is less probable than this is beyond doubt: "fail", where it is also large enough to matter.
CERTAIN = 1e-6
#: From best to worst; "unknown" is a question that the data cannot answer.
STATES = ("pass", "unknown", "warn", "fail")
#: ... of which these are of something wrong.
WRONG = STATES[2:]


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
    """

    name: str
    state: str = field(metadata=text(*STATES))
    value: float | None
    limit: float | None
    sentence: str
    cure: str = ""

    def __post_init__(self) -> None:
        for name in ("value", "limit"):
            number = getattr(self, name)
            if number is not None:  # plain numbers, as files and JSON have them
                object.__setattr__(self, name, float(number) if isfinite(number) else None)

    def __str__(self) -> str:
        return f"{self.state:7s} {self.name}: {self.sentence}{'; ' * bool(self.cure)}{self.cure}"


def state_of(p, matters=True):
    """State of a check whose finding has the probability p by chance, and may be large enough to matter."""
    return "pass" if p > FALSE_ALARM else "fail" if p < CERTAIN and matters else "warn"


def worst(checks):
    """The worst state of some checks; "pass" without any."""
    return max((check.state for check in checks), key=STATES.index, default="pass")


def in_lines(checks, *, width=110):
    """A line for what passes, and one for each check that does not, the worst first.

    Parameters
    ----------
    checks : iterable of Check
    width : int
        Characters of a line.

    Returns
    -------
    list of str
    """
    checks = tuple(checks)
    open_ones = sorted((c for c in checks if c.state != "pass"), key=lambda c: -STATES.index(c.state))
    passed = [c.name for c in checks if c.state == "pass"]
    lines = [f"checks  {len(passed)} of {len(checks)} pass" + (f": {', '.join(passed)}" if passed else "")]
    lines += [str(check) for check in open_ones]
    return [part for line in lines for part in textwrap.wrap(line, width, subsequent_indent=" " * 8)]
