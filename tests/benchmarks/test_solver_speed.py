"""Speed of the solvers: ``pytest tests/benchmarks --benchmark-only -c pyproject.toml``; not run by default."""

import pytest
import rivals
import sets

from legdistort import Matches, paper, solve


@pytest.fixture(scope="module", params=["simulation 1", "gsaoi-like", "large"])
def posed(request):
    sim, prior = sets.make(request.param)
    return request.param, sim, prior


@pytest.mark.benchmark(group="table to solution")
def test_joint(benchmark, posed):
    _, sim, prior = posed
    table, shape, poses = sim.matches.table, sim.matches.shapes, sim.matches.poses

    def road():
        return solve(Matches.from_table(table, shape=shape, poses=poses), prior=prior)

    road()  # compiled once, cached afterwards
    assert benchmark(road).dof > 0


@pytest.mark.benchmark(group="covariance, when first asked for")
def test_covariance(benchmark, posed):
    name, sim, prior = posed

    def fresh():
        return (solve(sim.matches, prior=prior),), {}

    stars = benchmark.pedantic(lambda solution: solution.stars, setup=fresh, rounds=1 if name == "large" else 5)
    assert len(stars)


@pytest.mark.benchmark(group="rivals")
@pytest.mark.parametrize("rival", ["scipy", "alternating"])
def test_rivals(benchmark, posed, rival):
    _, sim, prior = posed
    problem, start = sets.problem(sim, prior)
    if rival == "scipy":
        assert benchmark.pedantic(rivals.solve_scipy, args=(problem, start), rounds=1)[1] > 0
    else:
        result = benchmark.pedantic(paper.alternate, args=(problem, start), kwargs={"max_iterations": 300}, rounds=1)
        assert result.blocks.chi2 > 0
