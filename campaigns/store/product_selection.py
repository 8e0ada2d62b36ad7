"""Selection of the cases whose products are stored."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from marsyard.campaigns.definition.campaign_file import CampaignDefinition, Requirement
from marsyard.campaigns.definition.margins import compute_margin


@dataclass(frozen=True)
class ProductSelection:
    """Selection of the cases whose products are stored.

    - every: step between the numbers of selected cases; 0 to select none by number
    - requirements: a case that fails any of these requirements is selected
    - timelines: whether the products contain the timeline of the case (`marsyard.scenarios.timeline`)
    """

    every: int = 0
    requirements: tuple[Requirement, ...] = ()
    timelines: bool = False

    def selects(self, row: Mapping[str, Any]) -> bool:
        """Whether the case with this row is selected."""
        if self.every and row["case"] % self.every == 0:
            return True
        return any(compute_margin(row, requirement) < 0.0 for requirement in self.requirements)


ALL_PRODUCTS = ProductSelection(every=1)
REPLAYED_PRODUCTS = ProductSelection(every=1, timelines=True)


def create_product_selection(definition: CampaignDefinition) -> ProductSelection:
    """Create the selection for a campaign's first run of its cases; the worst cases run again at the end."""
    retain = definition.retain
    if retain.products == "all":
        return ALL_PRODUCTS
    if retain.products == "every":
        return ProductSelection(every=retain.every)
    if retain.products == "failed":
        return ProductSelection(requirements=definition.requirements)
    return ProductSelection()
