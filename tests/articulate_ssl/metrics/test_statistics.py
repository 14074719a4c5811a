import pytest
import torch

from articulate_ssl.metrics.statistics import cluster_bootstrap, summarize


def cluster_bootstrap_means_naive(values, cluster, draws):
    """Means of the pooled samples of drawn clusters."""
    return [torch.cat([values[cluster == c] for c in draw]).mean().item() for draw in draws.tolist()]


def test_bootstrap_equals_naive_resampling():
    generator = torch.Generator().manual_seed(0)
    cluster = torch.tensor([0, 0, 0, 1, 2, 2, 2, 2])
    values = torch.rand(8, generator=generator, dtype=torch.float64)
    draws = torch.randint(3, (500, 3), generator=torch.Generator().manual_seed(7))
    means = torch.tensor(cluster_bootstrap_means_naive(values, cluster, draws), dtype=torch.float64)
    low, high = cluster_bootstrap(values, cluster, replicates=500, seed=7)
    assert low == pytest.approx(means.quantile(0.025).item())
    assert high == pytest.approx(means.quantile(0.975).item())


def test_interval_covers_the_true_mean_where_samples_of_an_instance_agree():
    generator = torch.Generator().manual_seed(0)
    instance = torch.arange(30).repeat_interleave(20)
    covered, covered_without_clusters, trials = 0, 0, 200
    for trial in range(trials):
        effect = torch.randn(30, generator=generator)[instance]
        values = 5 + effect + 0.1 * torch.randn(600, generator=generator)
        low, high = cluster_bootstrap(values, instance, replicates=300, seed=trial)
        covered += low <= 5 <= high
        low, high = cluster_bootstrap(values, torch.arange(600), replicates=300, seed=trial)
        covered_without_clusters += low <= 5 <= high
    # 92 % and 40 % seen: samples of one instance must not count as independent.
    assert covered / trials > 0.88
    assert covered_without_clusters / trials < 0.5


def test_interval_is_reproducible_and_shrinks():
    generator = torch.Generator().manual_seed(0)
    values, instance = torch.rand(400, generator=generator), torch.arange(400)
    assert cluster_bootstrap(values, instance, 200, 0) == cluster_bootstrap(values, instance, 200, 0)
    few = cluster_bootstrap(values[:20], instance[:20], 200, 0)
    many = cluster_bootstrap(values, instance, 200, 0)
    assert many[1] - many[0] < (few[1] - few[0]) / 2


def test_summary_leaves_out_only_what_does_not_exist():
    values = torch.tensor([1.0, torch.nan, 3.0, 8.0])
    summary = summarize(values, torch.tensor([0, 0, 1, 1]))
    assert summary["mean"] == pytest.approx(4.0)
    assert summary["median"] == pytest.approx(3.0)
    assert summary["ci95"][0] <= 4.0 <= summary["ci95"][1]


def test_summary_without_values_or_with_one_instance():
    nothing = torch.full((3,), torch.nan)
    assert summarize(nothing, torch.arange(3)) == {"mean": None, "median": None, "ci95": None}
    assert summarize(torch.ones(3), torch.zeros(3, dtype=torch.long)) == {"mean": 1.0, "median": 1.0, "ci95": None}
