import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.validation.sampling_checks import all_seeds, collisions, seeds, stream_words
from marsyard.sim.streams import Streams, stream_key


def _first(streams: Streams, name: str) -> tuple[int, ...]:
    return tuple(streams.generator(name).integers(0, 2**63, 2))


def test_a_stream_depends_on_its_key_alone() -> None:
    one = Streams(7, "campaign", 3)
    alone = _first(one, "wind")
    _first(one, "sun")
    one.generator("wind").standard_normal(100)
    assert _first(one, "wind") == alone
    assert _first(Streams(7, "campaign", 3), "wind") == alone


@given(
    seeds=st.sets(st.integers(0, 2**40), min_size=2, max_size=2),
    campaigns=st.sets(st.text(max_size=5), min_size=2, max_size=2),
    cases=st.sets(st.integers(0, 2**31), min_size=2, max_size=2),
    names=st.sets(st.text(max_size=5), min_size=2, max_size=2),
)
def test_every_part_of_the_key_selects_another_stream(
    seeds: set[int], campaigns: set[str], cases: set[int], names: set[str]
) -> None:
    firsts = {
        _first(Streams(seed, campaign, case), name)
        for seed in seeds
        for campaign in campaigns
        for case in cases
        for name in names
    }
    assert len(firsts) == 16


def test_parts_of_the_key_do_not_run_together() -> None:
    """Names are hashed whole: no two keys share words by shifting letters between their parts."""
    assert _first(Streams(0, "ab", 0), "c") != _first(Streams(0, "a", 0), "bc")
    assert _first(Streams(1, "a", 0), "b") != _first(Streams(0, "a", 1), "b")


def test_streams_of_neighbouring_cases_are_uncorrelated() -> None:
    draws = np.stack([Streams(1, "c", case).generator("x").standard_normal(1000) for case in range(20)])
    correlation = np.corrcoef(draws) - np.eye(20)
    # 190 pairs of 1,000 draws: the largest of them stays below 4.5 standard errors
    assert np.abs(correlation).max() < 4.5 / np.sqrt(1000)


@given(
    seed=st.integers(0, 2**63 - 1), campaign=st.text(max_size=5), case=st.integers(0, 2**31), name=st.text(max_size=5)
)
def test_seeds_are_worked_out_as_numpy_does(seed: int, campaign: str, case: int, name: str) -> None:
    ours = seeds(stream_words(seed, campaign, np.array([case]), name))[0]
    numpys = np.random.SeedSequence(seed, spawn_key=stream_key(campaign, case, name)).pool
    assert ours.tolist() == numpys.view(np.uint64).tolist()


def test_no_two_of_four_hundred_thousand_streams_share_a_seed() -> None:
    """By chance that is one in 4e27; `make validate` does it with ten million."""
    names = [*(f"dispersion:{letter}" for letter in "abcdefghijklmnop"), "gusts", "landing", "altimeter", "clock"]
    found = all_seeds(campaigns=10, cases=2000, names=names)
    assert len(found) == 400_000
    assert collisions(found) == 0
    # and it would be seen
    assert collisions(np.concatenate([found, found[7:9]])) == 2
