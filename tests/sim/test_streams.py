"""Tests of random number streams and their keys: seed, campaign, case and name of the stream."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.validation.sampling_checks import all_seeds, collisions, seeds, stream_words
from marsyard.sim.streams import Streams, stream_key


def _draw_first_numbers(streams: Streams, name: str) -> tuple[int, ...]:
    return tuple(streams.generator(name).integers(0, 2**63, 2))


def test_stream_depends_only_on_its_key() -> None:
    streams = Streams(7, "campaign", 3)
    expected = _draw_first_numbers(streams, "wind")
    _draw_first_numbers(streams, "sun")
    streams.generator("wind").standard_normal(100)
    assert _draw_first_numbers(streams, "wind") == expected
    assert _draw_first_numbers(Streams(7, "campaign", 3), "wind") == expected


@given(
    seeds=st.sets(st.integers(0, 2**40), min_size=2, max_size=2),
    campaigns=st.sets(st.text(max_size=5), min_size=2, max_size=2),
    cases=st.sets(st.integers(0, 2**31), min_size=2, max_size=2),
    names=st.sets(st.text(max_size=5), min_size=2, max_size=2),
)
def test_each_key_part_selects_another_stream(
    seeds: set[int], campaigns: set[str], cases: set[int], names: set[str]
) -> None:
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
