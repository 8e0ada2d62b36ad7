"""Inputs that several cases share (terrains): which of them a campaign needs, and their preparation before the cases.

A shared input is built once into a cache on disk; a scenario numbers its shared inputs. An input that only one case
uses is built by this case in memory, so that the cache does not grow with the cases.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.cases import create_loader, definition_text, prepare_input, work_limits
from marsyard.campaigns.execution.work import Executor, Work
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.scenarios.interface import SelectsInputs
from marsyard.sim.cache import cache_directory, cached_bytes, limit_bytes


@dataclass(frozen=True)
class InputPlan:
    """Shared inputs of some cases.

    - present: numbers of the inputs on disk, if the scenario reports them
    - to_build: numbers of the inputs to be built, with their bytes on disk (0 if the scenario does not report them)
    - limit_bytes: size limit of the cache
    """

    present: tuple[int, ...]
    to_build: dict[int, int]
    limit_bytes: int

    @property
    def build_bytes(self) -> int:
        """Bytes on disk of all inputs to be built."""
        return sum(self.to_build.values())

    @property
    def to_prepare(self) -> tuple[int, ...]:
        """Inputs to be prepared before the cases: existing inputs are verified, new inputs are built up to the limit.

        Cases build the remaining inputs in memory.
        """
        selected, size = list(self.present), 0
        for number, input_bytes in self.to_build.items():
            size += input_bytes
            if size > self.limit_bytes:
                break
            selected.append(number)
        return tuple(selected)


def plan_inputs(campaign: Campaign, cases: Iterable[int] | None) -> InputPlan:
    """Plan the shared inputs of some of a campaign's cases; all shared inputs if `cases` is None (unknown cases).

    Raises CampaignError if the cache's limit is not a number, or its folder cannot be created.
    """
    scenario, base = campaign.scenario, campaign.base_parameters()
    numbers = scenario.shared_inputs(base) if cases is None else find_shared_inputs(campaign, cases)
    if not numbers:
        return InputPlan((), {}, 0)
    reports_inputs = isinstance(scenario, SelectsInputs)
    try:
        folder = cache_directory("terrain")
        limit = limit_bytes(folder, cached_bytes(folder))
        sizes = {
            number: scenario.missing_bytes(base, number) if isinstance(scenario, SelectsInputs) else 0
            for number in numbers
        }
    except OSError as error:
        raise CampaignError(f"the cache cannot be used: {error}") from error
    except ValueError as error:
        raise CampaignError(str(error)) from error
    present = tuple(number for number in numbers if reports_inputs and sizes[number] == 0)
    return InputPlan(present, {number: size for number, size in sizes.items() if number not in present}, limit)


def find_shared_inputs(campaign: Campaign, cases: Iterable[int]) -> tuple[int, ...]:
    """Find the inputs that several cases use; all shared inputs if the scenario does not report those of a case.

    The sampled values depend only on the number of the case. The search ends when all inputs have occurred twice: for
    64 terrains after about 400 cases, each of which takes two milliseconds.
    """
    scenario = campaign.scenario
    all_inputs = scenario.shared_inputs(campaign.base_parameters())
    if not all_inputs or not isinstance(scenario, SelectsInputs):
        return all_inputs
    uses = dict.fromkeys(all_inputs, 0)
    for case in cases:
        for number in find_case_inputs(campaign, scenario, case):
            if number in uses:
                uses[number] += 1
        if min(uses.values()) > 1:
            break
    return tuple(number for number, count in uses.items() if count > 1)


def find_case_inputs(campaign: Campaign, scenario: SelectsInputs, case: int) -> set[int]:
    """Find the inputs of a case; none if its values cannot be sampled: the row of the case will contain the reason."""
    try:
        return set(scenario.case_inputs(campaign.parameters(case), case))
    except ValueError:
        return set()


def prepare_inputs(
    campaign: Campaign, executor: Executor, observer: ProgressObserver, cases: Iterable[int] | None
) -> None:
    """Build the inputs that several cases share (see `plan_inputs`).

    A case whose input could not be prepared builds it; if this fails, its row contains the error.
    """
    plan = plan_inputs(campaign, cases)
    inputs = plan.to_prepare
    if plan.build_bytes > plan.limit_bytes:
        sizes = f"{plan.build_bytes / 1e9:.1f} GB, more than the cache limit ({plan.limit_bytes / 1e9:.1f} GB)"
        advice = "some are built more than once; MARSYARD_CACHE_GB sets the limit"
        observer.note(f"the terrains to be built need {sizes}: {advice}")
    if not inputs:
        return
    observer.begin("preparing", len(inputs))
    for result in chain.from_iterable(executor.run(preparation_work(campaign, inputs))):
        if result.error is not None:
            error = f"{type(result.error).__name__}: {result.error}"
            observer.note(f"shared input {result.item} could not be prepared: {error}")
        elif result.result:
            observer.note(result.result)
        observer.step()


def preparation_work(campaign: Campaign, inputs: Sequence[int]) -> Work[str]:
    """Create the work of building shared inputs; the result of an input is a note, empty in most cases."""
    definition = campaign.definition
    task = partial(prepare_input, definition_text(definition))
    limits = work_limits(definition.limits, definition.limits.prepare_time_s)
    return Work(task, inputs, limits, len(inputs), create_loader(definition))
