"""The verdict at the top of a report: what was checked, how it ended, what to do."""

from html import escape

from ..results.check import STATES

_WORDS = {
    "pass": "All checks pass",
    "unknown": "Nothing is wrong; not everything is known",
    "warn": "Something should be looked at",
    "fail": "This result should not be used as it is",
}


def verdict(checks):
    """The worst state in words, a row for each check that does not pass, and the others by name.

    Parameters
    ----------
    checks : list of dict
        Fields of `legdistort.results.check.Check`.

    Returns
    -------
    str
        HTML; empty without checks.
    """
    if not checks:
        return ""
    worst = max((check["state"] for check in checks), key=STATES.index)
    rows = sorted((c for c in checks if c["state"] != "pass"), key=lambda c: -STATES.index(c["state"]))
    body = "".join(_row(check) for check in rows)
    passed = "; ".join(f"{escape(c['name'])}: {escape(c['sentence'])}" for c in checks if c["state"] == "pass")
    table = f'<table class="checks">\n{body}</table>\n' if rows else ""
    n = sum(c["state"] == "pass" for c in checks)
    return (
        f'<section class="verdict {worst}"><h2>{_WORDS[worst]}</h2>\n{table}'
        f"<details><summary>{n} of {len(checks)} checks pass</summary>"
        f"<p><small>{passed}.</small></p></details></section>"
    )


def _row(check):
    cure = f"<br><b>What to do:</b> {_sentence(check['cure'])}" if check["cure"] else ""
    state = f'<span class="state {check["state"]}">{check["state"]}</span>'
    name = f'<th scope="row">{escape(check["name"])}</th>'
    return f"<tr><td>{state}</td>{name}<td>{_sentence(check['sentence'])}{cure}</td></tr>\n"


def _sentence(text):
    return f"{escape(text[0].upper() + text[1:])}."
