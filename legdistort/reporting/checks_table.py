"""The verdict at the top of a report: what was checked, how it ended, what to do."""

from ..results.check import STATES

_WORDS = {
    "pass": "All checks pass",
    "unknown": "Nothing is wrong; not everything is known",
    "warn": "Something should be looked at",
    "fail": "This result should not be used as it is",
}


def verdict(checks):
    """The worst state in words, the checks that do not pass, the worst first, and the others.

    Parameters
    ----------
    checks : list of dict
        Fields of `legdistort.results.check.Check`.

    Returns
    -------
    dict or None
        ``worst``, ``words``, ``open``, ``passed``; None without checks.
    """
    if not checks:
        return None
    worst = max((check["state"] for check in checks), key=STATES.index)
    rows = sorted((c for c in checks if c["state"] != "pass"), key=lambda c: -STATES.index(c["state"]))
    passed = [check for check in checks if check["state"] == "pass"]
    return {"worst": worst, "words": _WORDS[worst], "open": rows, "passed": passed, "n": len(checks)}
