"""Tests of random number streams and their keys: seed, campaign, case and name of the stream."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from benchmarks.validation.sampling_checks import all_seeds, collisions, seeds, stream_words
from marsyard.sim.streams import Blend, Streams, stream_key, substream


def _draw_first_numbers(streams: Streams, name: str) -> tuple[int, ...]:
    return tuple(streams.generator(name).integers(0, 2**63, 2))


def test_stream_depends_only_on_its_key() -> None:
    streams = Streams(7, "campaign", 3)
    expected = _draw_first_numbers(streams, "wind")
    _draw_first_numbers(streams, "sun")
    streams.generator("wind").standard_normal(100)
    assert _draw_first_numbers(streams, "wind") == expected
    assert _draw_first_numbers(Streams(7, "campaign", 3), "wind") == expected


def test_substreams_depend_only_on_their_name() -> None:
    rng = np.random.default_rng(7)
    first = substream(rng, "dunes").random(3)
    rng.random(100)
    rng.spawn(2)
    np.testing.assert_array_equal(substream(rng, "dunes").random(3), first)
    assert not np.array_equal(substream(rng, "lava").random(3), first)
    assert not np.array_equal(substream(np.random.default_rng(8), "dunes").random(3), first)


@given(
    seeds=st.sets(st.integers(0, 2**40), min_size=2, max_size=2),
    campaigns=st.sets(st.text(max_size=5), min_size=2, max_size=2),
    cases=st.sets(st.integers(0, 2**31), min_size=2, max_size=2),
    names=st.sets(st.text(max_size=5), min_size=2, max_size=2),
)
def test_key_parts_select_other_streams(seeds: set[int], campaigns: set[str], cases: set[int], names: set[str]) -> None:
    first_numbers = {
        _draw_first_numbers(Streams(seed, campaign, case), name)
        for seed in seeds
        for campaign in campaigns
        for case in cases
        for name in names
    }
    assert len(first_numbers) == 16


def test_key_parts_are_hashed_separately() -> None:
    """Moving a letter from one part to another changes the stream."""
    assert _draw_first_numbers(Streams(0, "ab", 0), "c") != _draw_first_numbers(Streams(0, "a", 0), "bc")
    assert _draw_first_numbers(Streams(1, "a", 0), "b") != _draw_first_numbers(Streams(0, "a", 1), "b")


def test_streams_of_neighbouring_cases_are_uncorrelated() -> None:
    draws = np.stack([Streams(1, "c", case).generator("x").standard_normal(1000) for case in range(20)])
    correlation = np.corrcoef(draws) - np.eye(20)
    # 190 pairs of 1,000 draws: the largest correlation is below 4.5 standard errors.
    assert np.abs(correlation).max() < 4.5 / np.sqrt(1000)


@given(
    seed=st.integers(0, 2**63 - 1), campaign=st.text(max_size=5), case=st.integers(0, 2**31), name=st.text(max_size=5)
)
def test_seeds_match_numpy(seed: int, campaign: str, case: int, name: str) -> None:
    actual = seeds(stream_words(seed, campaign, np.array([case]), name))[0]
    expected = np.random.SeedSequence(seed, spawn_key=stream_key(campaign, case, name)).pool
    assert actual.tolist() == expected.view(np.uint64).tolist()


def test_400_000_streams_have_different_seeds() -> None:
    """The probability of a collision is 1 in 4e27; `make validate` tests ten million."""
    names = [*(f"dispersion:{letter}" for letter in "abcdefghijklmnop"), "gusts", "landing", "altimeter", "clock"]
    result = all_seeds(campaigns=10, cases=2000, names=names)
    assert len(result) == 400_000
    assert collisions(result) == 0
    # `collisions` detects duplicates.
    assert collisions(np.concatenate([result, result[7:9]])) == 2


def _blended(step: float, name: str = "imu") -> np.random.Generator:
    """Blend the streams of case 8 into those of case 7."""
    blend = ((7, float(np.sqrt(1.0 - step**2))), (8, step))
    return Streams(5, "campaign", 8, blend).generator(name)


@pytest.mark.parametrize("step", [0.1, 0.6, 0.95])
def test_blended_numbers_keep_their_distribution(step: float) -> None:
    generator = _blended(step)
    assert kstest(generator.standard_normal(20_000), "norm").pvalue > 0.001
    assert kstest(generator.normal(3.0, 2.0, 20_000), "norm", (3.0, 2.0)).pvalue > 0.001
    assert kstest(generator.random(20_000), "uniform").pvalue > 0.001
    assert kstest(generator.uniform(-2.0, 4.0, 20_000), "uniform", (-2.0, 6.0)).pvalue > 0.001


def test_blended_numbers_change_continuously() -> None:
    """The correlation with the numbers of the older component is its weight; large draws are those of the newest."""
    older = Streams(5, "campaign", 7).generator("imu").standard_normal(20_000)
    for step in (0.01, 0.3):
        blended = _blended(step).standard_normal(20_000)
        assert np.corrcoef(older, blended)[0, 1] == pytest.approx(np.sqrt(1.0 - step**2), abs=0.02)
    newest = Streams(5, "campaign", 8, ((8, 1.0),)).generator("detector").standard_normal((400, 400), dtype=np.float32)
    np.testing.assert_array_equal(_blended(0.3, "detector").standard_normal((400, 400), dtype=np.float32), newest)
    # one component has the numbers of its case
    alone, blended = (
        Streams(5, "campaign", 8, *blend).generator("imu").standard_normal(10) for blend in ((), (((8, 1.0),),))
    )
    np.testing.assert_array_equal(blended, alone)


def test_components_do_not_depend_on_the_other_draws_of_a_case() -> None:
    """Integers and large draws are new in each step; the normal and uniform numbers after them are not."""

    def draw(blend: Blend, other_draws: int) -> list[float]:
        generator = Streams(5, "campaign", blend[-1][0], blend).generator("imu")
        generator.integers(0, 10, other_draws)
        generator.standard_normal(other_draws * 200_000)
        return [generator.normal(), generator.random(), *generator.uniform(0.0, 1.0, 2)]

    older = draw(((7, 1.0),), 3)
    assert draw(((7, 1.0), (8, 0.0)), 1) == older
    assert draw(((7, 1.0), (8, 0.0)), 0) == older


def test_blended_numbers_have_the_shapes_of_numpy() -> None:
    generator = _blended(0.5)
    assert isinstance(generator.standard_normal(), float)
    assert isinstance(generator.random(), float)
    assert isinstance(generator.normal(1.0, 2.0), float)
    assert generator.normal(np.zeros((2, 3)), 1.0).shape == (2, 3)
    assert generator.uniform(np.zeros(4), 1.0).shape == (4,)
    assert generator.standard_normal((2, 2), dtype=np.float32).dtype == np.float32
    assert 0 <= int(generator.integers(10)) < 10
    assert [child.random() for child in generator.spawn(2)] != [generator.random()] * 2


def test_one_component_has_the_numbers_of_its_case() -> None:
    alone = Streams(5, "campaign", 8).generator("imu").standard_normal(10)
    np.testing.assert_array_equal(Streams(5, "campaign", 8, ((8, 1.0),)).generator("imu").standard_normal(10), alone)
