"""Published albedo, slope and relief of sites, with which `marsyard terrain stats` compares the simulated terrain."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedSite:
    """Published values of a site: minimum and maximum; slopes are those for baselines of 30 m and 90 m.

    - contrast: the publication's words on the contrast of the ground
    """

    albedo: tuple[float, float]
    mean_slope_deg: tuple[float, float]
    relief_m: tuple[float, float] | None
    contrast: str


_MER_SITE = PublishedSite((0.1, 0.3), (1.0, 2.0), None, "MOC: a lower limit, seen through dust")
#: DIMES field test paper, section III.A; it contains common values for the MER landing sites.
PUBLISHED_SITES: dict[str, PublishedSite] = {
    "pisgah": PublishedSite((0.1, 0.1), (2.0, 3.0), None, "very little; like synthesised images of most MER sites"),
    "kelso": PublishedSite((0.5, 0.5), (2.0, 3.0), (200.0, float("inf")), "repetitive"),
    "ivanpah": PublishedSite((0.4, 0.4), (2.0, 3.0), None, "bland; the smoothest of the field sites"),
    "gusev": _MER_SITE,
    "meridiani": _MER_SITE,
}
