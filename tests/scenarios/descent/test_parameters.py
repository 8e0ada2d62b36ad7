"""What a descent's parameters take, and what a site makes of them."""

import pytest
from pydantic import ValidationError

from scenarios.descent import DescentScenarioParameters
from scenarios.descent.world import World
from sim.terrain import site

#: A site on Mars and one on Earth.
SITES = ("gusev", "ivanpah")


@pytest.mark.parametrize(
    ("wrong", "names"),
    [
        ({"place": {"bank": 2, "terrain": 2}}, "0 to 1"),
        ({"descent": {"altitude_first_m": -5.0}}, "altitude_first_m"),
        ({"descent": {"wind_south_m_s": 1.0}}, "wind_south_m_s"),
        ({"render": {"backend": "vulkan"}}, "osmesa"),
        ({"site": "mars-yard"}, "gusev"),
        ({"site": "gusev", "terrain": {"sample": 512}}, "terrain.sample"),
        ({"algorithm": "dime"}, "did you mean 'dimes'"),
        ({"algorithm": "algorithms.dimes:Nothing"}, "no algorithm"),
        ({"dimes": {"templates": 3}}, "templates"),
        ({"faults": {"hase": 1.0}}, "hase"),
    ],
)
def test_impossible_parameters_are_named(wrong, names) -> None:
    with pytest.raises(ValidationError, match=names):
        DescentScenarioParameters.model_validate(wrong)


def test_a_site_brings_its_terrain_with_what_is_set_over_it() -> None:
    stated = {"site": "gusev", "terrain": {"samples": 512, "spacing_m": 8.0, "rocks": {"smallest_m": 2.0}}}
    p = DescentScenarioParameters.model_validate(stated)
    of_site = site("gusev").terrain("descent")
    rocks = of_site.rocks
    assert rocks is not None
    changed = {"samples": 512, "spacing_m": 8.0, "rocks": rocks.model_copy(update={"smallest_m": 2.0})}
    assert p.terrain == of_site.model_copy(update=changed)


def test_a_site_is_not_dispersed() -> None:
    """The terrain was completed when the campaign was read: another site's name would only change its light."""
    complete = DescentScenarioParameters.model_validate({"site": "gusev"}).model_dump(mode="json", round_trip=True)
    with pytest.raises(ValidationError, match="the terrain is of gusev"):
        DescentScenarioParameters.model_validate(complete | {"site": "kelso"})


@pytest.mark.parametrize("stated", [{}, {"site": "kelso"}, {"dimes": {"subpixel": False}, "faults": {"haze": 2.0}}])
def test_complete_parameters_are_read_back_as_they_were(stated) -> None:
    """As a campaign's workers do."""
    p = DescentScenarioParameters.model_validate(stated)
    assert DescentScenarioParameters.model_validate(p.model_dump(mode="json", round_trip=True)) == p


def test_a_site_is_lit_as_it_is() -> None:
    """Sunlight and reflectance are the site's; signals follow sunlight and air."""
    small = {"terrain": {"samples": 256, "spacing_m": 16.0}, "place": {"bank": 1}}
    mars, earth = (World.of(DescentScenarioParameters.model_validate({"site": name} | small)) for name in SITES)
    assert mars.ground is not None
    assert mars.sun.angular_radius_rad == pytest.approx(0.00308, rel=0.01)
    # twice the sunlight and more: Mars' air is dusty
    assert earth.brightness / mars.brightness > 1.0 / 0.44
    scene = mars.scene(0.0, 0.0, 1400.0, 8.2e-4, caster_diameter_m=10.9)
    assert scene.caster_diameter_m == 10.9
    assert scene.photometry == mars.ground.photometry(mars.sun)
    assert len(scene.objects) > 0
