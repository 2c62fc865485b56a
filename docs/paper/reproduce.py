"""Reproduce the paper: ``python docs/paper/reproduce.py`` (7 minutes on 2 cores; ``--quick``: half a minute).

Runs the simulations of Bernard et al. (2017), the twin of its GeMS data, and the comparisons beyond it, prints every
published number beside ours, and writes the table (``table.md``), the numbers (``results.json``) and the figures.
With ``--quick`` fewer outcomes and smaller images are used, and nothing is written unless ``--out`` is given.
"""

import argparse
import json
import os
import sys
import tempfile
import time
import warnings
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small; the work is shared among processes

import families
import figures
import gems
import keck
import numpy as np
import simulations

import legdistort as ld
from legdistort import paper
from legdistort.assessment import baselines
from legdistort.assessment.stack_quality import assess
from legdistort.exceptions import LegdistortWarning
from legdistort.geometry.gsaoi import GsaoiMap
from legdistort.results import accuracy

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Row:
    """One published number and ours."""

    where: str
    what: str
    paper: str
    ours: str
    remark: str = ""


@dataclass(frozen=True)
class Plan:
    """How large everything is."""

    quick: bool
    images: Path | None

    @property
    def n(self):
        """Outcomes for every level of noise."""
        return 6 if self.quick else simulations.N_OUTCOMES

    def save(self, fig, name):
        """Write a figure, if pictures are wanted."""
        if self.images is not None:
            figures.save(fig, name, self.images)
        else:
            figures.plt.close(fig)


def model(plan):
    """Section 2: figures only."""
    plan.save(figures.first_modes(), "leg")
    plan.save(figures.application(ld.simulate_matches(n_exposures=3, seed=3)), "distoschem")
    sim = ld.simulate_matches(n_exposures=30, seed=1)
    solution = paper.solve(sim.matches, prior=ld.Prior(sim.truth.static))
    plan.save(figures.one_star(sim, solution), "schema")
    corrected = accuracy.corrected_positions(solution)
    apart = np.abs(np.nanmean(corrected, axis=0) - solution.estimate.positions).max()
    yield Row("3.3", "mean of corrected positions − X_ref, px", "a few 0.001", f"{apart:.4f}", "largest of 30 stars")


def simulation_1(plan):
    """Section 4.1."""
    sim, solution, grid, sigma, square = simulations.simulation_1(n_grid=50 if plan.quick else simulations.N_GRID)
    plan.save(figures.error_map(sim, grid, sigma, square), "ergrid")
    inside = accuracy.in_contour(grid, square)
    b = accuracy.bias(solution.estimate.positions, sim.truth.positions)
    yield Row("Sim. 1", "b, px", "0.05", f"{b:.3f}", "one outcome")
    yield Row("Sim. 1", "σ_contour, px", "0.16", f"{simulations.rms(sigma[inside]):.3f}", "one outcome")
    yield Row("Sim. 1", "σ_grid, px", "0.2", f"{simulations.rms(sigma):.3f}", "one outcome")
    yield Row("Sim. 1", "σ_j' smallest and largest, px", "0.05, 0.7", f"{sigma.min():.2f}, {sigma.max():.2f}")


def simulations_2_to_4(plan, pool=None):
    """Section 4.2; the outcomes are shared among the processes of a pool."""
    n_grid = 30 if plan.quick else simulations.N_GRID

    def propagate(**settings):
        # on many exposures the rms over a coarser grid is known as well
        coarse = 30 if settings.get("n_exposures", 10) > 10 else n_grid
        return simulations.propagate(n=plan.n, pool=pool, **({"n_grid": coarse} | settings))

    usual = propagate()
    by_exposures = {n: usual if n == 10 else propagate(n_exposures=n) for n in (2, 10, 50, 100)}
    by_stars = {n: usual if n == 30 else propagate(n_stars=n) for n in (20, 30, 100, 200)}
    start_off = propagate(zero_mean=False, n_grid=0)
    unknown = propagate(static_known=False, n_grid=0)
    plan.save(figures.noise_propagation(usual), "erbilan")
    law = figures.slopes(by_exposures, "number of exposures", law=lambda n: 1 / np.sqrt(n), law_label="1 / √n_im")
    plan.save(law, "erim")
    plan.save(figures.slopes(by_stars, "number of stars", law=np.ones_like, law_label="1"), "erstar")
    zero = simulations.noiseless()
    yield Row("Sim. 2", "b and σ at σ_meas = 0, px", "0, 0", f"{zero[0]:.1e}, {zero[2]:.1e}", "no noise")
    at = list(usual.levels).index(0.14)
    yield Row("Sim. 2", "b at σ_meas = 0.14 px, px", "0.05", f"{usual.curves[at, 0]:.4f}")
    yield Row("Sim. 2", "σ at σ_meas = 0.14 px, px", "0.16", f"{usual.curves[at, 2]:.4f}")
    yield Row("Sim. 2", "slope s_b", "0.3", _with_error(usual.slope(0)), "1/√10 = 0.316")
    yield Row("Sim. 2", "slope s_σ", "1.2", _with_error(usual.slope(2)))
    for n, found in by_exposures.items():
        remark = f"1/√{n} = {1 / np.sqrt(n):.3f}"
        yield Row("Sim. 3", f"s_b, {n} exposures", f"~{1 / np.sqrt(n):.2f}", _with_error(found.slope(0)), remark)
    for n, found in by_exposures.items():
        remark = f"with 1/n_im in its definition σ is √(1 − 1/{n}) = {np.sqrt(1 - 1 / n):.3f} times the scatter"
        yield Row("Sim. 3", f"s_σ, {n} exposures", "1.2, whatever n_im", _with_error(found.slope(2)), remark)
    published = {20: "", 30: "1.2", 100: "~1", 200: "~1"}
    for n, found in by_stars.items():
        rule = np.sqrt(0.9 * (1 + 10 / n))
        yield Row(
            "Sim. 4",
            f"s_σ, {n} stars",
            published[n],
            _with_error(found.slope(2)),
            f"rule √(0.9 (1 + 10/n)) = {rule:.2f}",
        )
    for n, found in by_stars.items():
        yield Row("Sim. 4", f"s_b, {n} stars", "0.3", _with_error(found.slope(0)))
    yield Row("not in the paper", "b, px: static part known, dynamic parts do not sum to zero", "",
              f"{start_off.curves[at, 0]:.2f}", f"{start_off.curves[at, 1]:.3f} after a common cubic map")  # fmt: skip
    yield Row("not in the paper", "b, px: no static part known", "",
              f"{unknown.curves[at, 0]:.2f}", f"{unknown.curves[at, 1]:.3f} after a common cubic map")  # fmt: skip


def simulation_5(plan):
    """Section 4.3."""
    found = {kind: simulations.simulation_5(kind) for kind in ("monomial", "legendre", "common")}
    plan.save(figures.aliasing(found), "spec1")
    names = {"monomial": "plain x⁴", "legendre": "mode L₄(x)", "common": "mode L₄(x), alike in all exposures"}
    for kind, (errors, b) in found.items():
        rms = np.mean(errors**2, axis=0)
        paper = "100 %" if kind == "monomial" else ""
        even = rms[0, [0, 3]].sum() / rms.sum()
        remark = f"{100 * even:.0f} % of it in x⁰ and x² along x; b = {b:.3f} px"
        yield Row("Sim. 5", f"energy aliased, {names[kind]}", paper, f"{100 * rms.sum():.1f} %", remark)


def twin(plan, folder):
    """Section 5, from images."""
    instrument = GsaoiMap(2)
    t = np.linspace(0, 2047, 65)
    q = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    move = instrument.distort(q) - q
    design = np.column_stack([np.ones(len(q)), q])
    peak = np.abs(move - design @ np.linalg.lstsq(design, move, rcond=None)[0]).max(axis=0)
    plan.save(figures.static_map(), "disto")
    ours = f"{peak[0]:.1f}, {peak[1]:.1f}"
    remark = "published Gemini polynomials, not the map of Massari et al. (2016)"
    yield Row("5", "peak of the static map beyond its linear part, px", "5 in x, 0.5 in y", ours, remark)
    with_residue = gems.observe(folder / "twin", small=plan.quick)
    yield from _catalogue(with_residue)
    curve = _noise(plan, with_residue)
    plan.save(figures.measured_errors(with_residue), "star")
    solutions = gems.correct(with_residue)
    yield from _four(solutions, with_residue, "twin with residue, weights 1/σ_meas² as in the paper", published=True)
    name = solutions[baselines.METHOD].names[0]
    plan.save(figures.used_stars(with_residue, name), "stars")
    plan.save(figures.corrections(solutions, curve), "ercomp")
    plan.save(figures.coefficients(solutions[baselines.METHOD], name), "coeff")
    yield from _stack(plan, with_residue, solutions)
    floor = gems.correct(with_residue, errors="floor")
    yield from _four(floor, with_residue, "the same, with the error floor that chi2 asks for")
    without = gems.observe(folder / "without", residue=False, small=plan.quick)
    solutions = gems.correct(without)
    plan.save(figures.corrections(solutions, curve), "ercomp_without")
    yield from _four(solutions, without, "twin without residue")


def _catalogue(twin_):
    table = twin_.matches.table
    counts = [int(np.count_nonzero(table["exposure"] == name)) for name in twin_.matches.names]
    error = np.concatenate([table["x_err"].value, table["y_err"].value])
    yield Row("5.2", "stars in a catalogue", "61 to 78", f"{min(counts)} to {max(counts)}", "measured in the images")
    yield Row(
        "5.2", "σ_meas, px", "0.002 to 0.14", f"{error.min():.4f} to {error.max():.3f}", "fainter stars cut at 0.14"
    )
    fwhm = 20 * float(np.median(table["fwhm"].value))
    yield Row("5.2", "FWHM, mas", "90", f"{fwhm:.0f}", "median of the fits, at 20 mas a pixel")


def _noise(plan, twin_):
    """Figure "noiseflux", and the curve of 90 mas for the others."""
    fluxes = np.geomspace(2e3, 2e6, 5 if plan.quick else 9)
    widths = (4.5,) if plan.quick else (3.5, 4.5, 5.5, 6.5)
    options = {"n": 25, "size": 512} if plan.quick else {}
    curves = {w: gems.noise_curve(twin_.exposures[0], twin_.night, w, fluxes, **options) for w in widths}
    plan.save(figures.noise_flux(fluxes, curves), "noiseflux")
    good = np.isfinite(curves[4.5])
    x, y = np.log(fluxes[good]), np.log(curves[4.5][good])
    return lambda flux: np.exp(np.interp(np.log(flux), x, y))


def _four(solutions, twin_, label, *, published=False):
    paper = dict(zip(solutions, ("0.83 ± 0.40", "0.41 ± 0.21", "0.24 ± 0.21", "0.20 ± 0.20"), strict=False))
    for name, solution in solutions.items():
        s = accuracy.scatter_summary(solution)
        both = f"both axes {s['mean_total']:.3f} ± {s['std_total']:.3f}; {label}"
        yield Row(
            "5.3",
            f"σ_j, px: {name}",
            paper.get(name, "") if published else "",
            f"{s['mean']:.3f} ± {s['std']:.3f}",
            both,
        )
    method = solutions[baselines.METHOD]
    b = gems.absolute_error(twin_, method, removed=method.degree)
    remark = f"{gems.absolute_error(twin_, method, removed='similarity'):.3f} px absolute; {label}"
    yield Row("not in the paper", "b after a common cubic map, px", "", f"{b:.3f}", remark)


def _stack(plan, twin_, solutions):
    """Figures "im" and "stars2", and how sharp the stacks are."""
    method, static = solutions[baselines.METHOD], solutions["static + shift"]
    exposures = {e.name: e for e in twin_.exposures}
    mosaics = [ld.coadd([exposures[name] for name in s.names], s) for s in (method, static)]
    zooms = _zooms(method, static)
    plan.save(figures.stacks(*mosaics, zooms), "stack")
    for mosaic, solution, name in zip(mosaics, (method, static), ("all solved", "static + shift"), strict=True):
        ratio = assess(mosaic, solution, exposures=twin_.exposures).fwhm_ratio
        yield Row(
            "5.3",
            f"FWHM in the stack over that in an exposure: {name}",
            "",
            f"{ratio:.3f}",
            "brighter half of the stars",
        )


def _zooms(method, static, n=2, apart=400, least=8):
    """Where the static correction is worst, among the brighter half of the stars, on most exposures."""
    corrected = accuracy.corrected_positions(static)
    sigma = np.nan_to_num(accuracy.scatter(corrected))
    seen = np.isfinite(corrected[..., 0]).sum(axis=0)
    bright = np.asarray(method.stars["flux"]) > np.nanmedian(method.stars["flux"])
    chosen = []
    for k in np.argsort(-np.where(bright & (seen >= min(least, len(static.names))), sigma, 0)):
        if all(np.hypot(*(method.estimate.positions[k] - other)) > apart for other in chosen):
            chosen.append(method.estimate.positions[k])
    return chosen[:n]


def beyond(plan):
    """Model families and real lists."""
    folder = families.data_folder()
    fits = {
        name: {family: families.fit(*given, family) for family in families.FAMILIES}
        for name, given in families.maps(folder).items()
    }
    noisy = {
        name: {family: families.stars_only(*given, family) for family in families.FAMILIES}
        for name, given in families.maps(folder).items()
    }
    plan.save(figures.model_families(fits, noisy), "families")
    for name, found in fits.items():
        for family, fit in found.items():
            k = int(np.argmax(fit.residual < 0.01)) if (fit.residual < 0.01).any() else -1
            what = f"{name}, {family}: coefficients per axis for 0.01 px"
            remark = f"condition {fit.condition[k]:.1g}"
            yield Row("2.1", what, "", str(fit.needed(0.01) or "not reached"), remark)
    if folder is None:
        print("real data absent (set LEGDISTORT_DATA): the NIRC2 map and lists are left out", file=sys.stderr)
        return
    if plan.quick:
        return
    found = keck.summary(folder)
    plan.save(figures.real_lists(found), "keck")
    for label, made in found.items():
        for (degree, name), floor in made["floor"].items():
            yield Row(label, f"degree {degree}, prior {name}: error floor, px", "", f"{floor:.3f}",
                      f"left out and predicted: {made['held_out'][degree, name]:.3f} px")  # fmt: skip
        for (degree, name), (scale, error, gain) in made["scale"].items():
            remark = f"χ² falls by {gain:.0f}"
            yield Row(
                label, f"degree {degree}: multiple of the {name} wanted", "", f"{scale:.2f} ± {error:.2f}", remark
            )
        for name, solution in made["corrections"].items():
            s = accuracy.scatter_summary(solution)
            yield Row(label, f"σ_j, px: {name}", "", f"{s['mean']:.3f} ± {s['std']:.3f}", f"{s['n_stars']} stars")


def _with_error(slope):
    return f"{slope[0]:.3f} ± {slope[1]:.3f}"


def write(found, folder):
    """All rows as JSON, ``{part: rows}``, those of an earlier run kept for other parts, and the table as Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "results.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    known |= {part: [asdict(row) for row in rows] for part, rows in found.items()}
    known = {part: known[part] for part in PARTS if part in known}
    path.write_text(json.dumps(known, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    lines = ["| where | what | paper | ours | remark |", "|---|---|---|---|---|"]
    for rows in known.values():
        lines += [f"| {' | '.join(row.values())} |" for row in rows]
    (folder / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def run_part(name, plan):
    """Rows of one part, as a list."""
    warnings.simplefilter("ignore", LegdistortWarning)
    with tempfile.TemporaryDirectory() as folder:
        return list(PARTS[name](plan, Path(folder)))


PARTS = {
    "model": lambda plan, _: [*model(plan), *simulation_1(plan)],
    "noise": lambda plan, _: simulations_2_to_4(plan),
    "aliasing": lambda plan, _: simulation_5(plan),
    "twin": twin,
    "beyond": lambda plan, _: beyond(plan),
}


def main(argv=None):
    """Run everything; returns the rows of the table, ``{part: rows}``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few outcomes, small images")
    parser.add_argument("--out", type=Path, help="folder for table and figures (default: the documentation)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--only", nargs="+", choices=PARTS, help="parts to run; the rest of the table stays")
    a = parser.parse_args(argv)
    out = a.out or (None if a.quick else HERE)
    plan = Plan(a.quick, None if out is None else figures.IMAGES if a.out is None else a.out)
    begin, wanted = time.perf_counter(), a.only or list(PARTS)
    with ProcessPoolExecutor(a.workers) as pool:
        others = {pool.submit(run_part, name, plan): name for name in wanted if name != "noise"}
        # the noise is shared out among what processes are free; the rest are one job each
        found = {"noise": _tell("noise", list(simulations_2_to_4(plan, pool)), begin)} if "noise" in wanted else {}
        for future in as_completed(others):
            found[others[future]] = _tell(others[future], future.result(), begin)
    if out is not None:
        write(found, out)
    print(f"{time.perf_counter() - begin:.0f} s in all")
    return found


def _tell(part, rows, begin):
    for row in rows:
        print(f"{row.where:18s} {row.what:62s} {row.paper:20s} {row.ours:22s} {row.remark}", flush=True)
    print(f"-- {part} done after {time.perf_counter() - begin:.0f} s", flush=True)
    return rows


if __name__ == "__main__":
    main()
