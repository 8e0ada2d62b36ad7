"""The sites that ship with Marsyard. What is not cited is assumed, chosen to meet what the papers say of the site."""

from __future__ import annotations

from marsyard.sim.terrain.environment import Environment
from marsyard.sim.terrain.landforms import Dunes, Fans, Gullies, Lava, Playa, Swell
from marsyard.sim.terrain.parameters import TerrainParameters
from marsyard.sim.terrain.rocks import RockParameters
from marsyard.sim.terrain.sites import Site, SitePhotometry, texture

#: Optical depth 0.9 at both MER landings (Lemmon et al. 2004); single-scattering albedo and asymmetry of Martian dust
#: in red light after Ockert-Bell et al. (1997).
MARS = Environment(optical_depth=0.9)
#: The Mojave in October: clear desert air, aerosol and molecules together.
MOJAVE = Environment(
    planet="Earth",
    gravity_m_s2=9.796,
    rotation_rad_s=7.2921e-5,
    solar_irradiance=1.0,
    optical_depth=0.2,
    single_scattering_albedo=0.95,
    asymmetry=0.5,
)
#: The Jet Propulsion Laboratory's Arroyo Seco: hazier.
PASADENA = MOJAVE.model_copy(update={"optical_depth": 0.35, "asymmetry": 0.6})

MARS_LAW = "L: McEwen (1991); surge: representative of soils in Johnson et al. (2006), Pancam at Gusev and Meridiani"

#: Over 100 m at 2.5 cm for rovers, over 200 m at 5 cm for helicopters.
ROVER_GROUND = TerrainParameters(
    samples=4096,
    spacing_m=0.025,
    hurst=0.75,
    rms_slope_deg=3.0,
    slope_baseline_m=1.0,
    outer_scale_m=15.0,
    craters_per_km2=8000.0,
    crater_diameter_min_m=0.6,
    crater_diameter_max_m=12.0,
    albedo_hurst=-0.2,
)
HELICOPTER_GROUND = ROVER_GROUND.model_copy(
    update={"spacing_m": 0.05, "slope_baseline_m": 3.0, "outer_scale_m": 40.0, "craters_per_km2": 0.0, "albedo": 0.25}
)

PISGAH = Site(
    name="pisgah",
    description="Pisgah lava flow, California: dark pahoehoe and a'a, rough at a few metres and gentle beyond",
    environment=MOJAVE,
    photometry=SitePhotometry(lunar_share=0.6, surge_amplitude=0.9, surge_width=0.08, rock_albedo=0.09),
    ground_texture=texture(3.0, 0.001, 0.06, decay=1.28),
    rock_texture=texture(0.2, 0.001, 0.22, decay=1.05),
    descent=TerrainParameters(
        hurst=0.95,
        rms_slope_deg=2.65,
        slope_baseline_m=90.0,
        outer_scale_m=2500.0,
        craters_per_km2=0.0,
        albedo=0.1,
        albedo_contrast=0.05,
        lava=Lava(lobe_thickness_m=0.9, layers=2.2, aa_relief_m=0.35),
        rocks=RockParameters(abundance=0.15, smallest_m=1.5, form="clinker"),
    ),
    ground=ROVER_GROUND.model_copy(
        update={
            "hurst": 0.5,
            "rms_slope_deg": 4.0,
            "craters_per_km2": 0.0,
            "albedo": 0.1,
            "albedo_contrast": 0.08,
            "lava": Lava(
                lobe_length_m=3.0,
                lobe_thickness_m=0.12,
                layers=2.0,
                aa_block_m=0.35,
                aa_share=0.5,
                aa_relief_m=0.09,
                pahoehoe_relief_m=0.012,
            ),
            # pahoehoe ropes
            "ripples": Dunes(
                wavelength_m=0.22,
                height_m=0.025,
                wind_from_deg=100.0,
                crest_length=2.5,
                regularity=1.0,
                repose_deg=34.0,
            ),
            "rocks": RockParameters(abundance=0.15, form="clinker"),
        }
    ),
)

KELSO = Site(
    name="kelso",
    description="Kelso dunes, California: bright, repetitive sand dunes over 200 m of relief",
    environment=MOJAVE,
    photometry=SitePhotometry(lunar_share=0.4, surge_amplitude=0.4, surge_width=0.05, rock_albedo=0.3),
    ground_texture=texture(3.0, 0.001, 0.02, decay=1.3),
    rock_texture=texture(0.2, 0.001, 0.1, decay=1.1),
    descent=TerrainParameters(
        hurst=0.7,
        rms_slope_deg=0.6,
        outer_scale_m=1500.0,
        craters_per_km2=0.0,
        albedo=0.5,
        albedo_contrast=0.03,
        swell=Swell(relief_m=207.0),
        # Crests that wind and branch, with smaller dunes upon them. How irregular they are is a calibration: over
        # straighter crests (1.8 and 0.9 wavelengths) DIMES refuses a third of the triples close in time, which in the
        # field test were all valid.
        dunes=Dunes(
            wavelength_m=115.0, height_m=3.6, wind_from_deg=290.0, repose_deg=33.0, crest_length=0.8, regularity=0.5
        ),
        ripples=Dunes(
            wavelength_m=30.0, height_m=0.6, wind_from_deg=275.0, repose_deg=14.0, crest_length=1.0, regularity=0.5
        ),
    ),
    ground=ROVER_GROUND.model_copy(
        update={
            "rms_slope_deg": 1.0,
            "craters_per_km2": 0.0,
            "albedo": 0.5,
            "albedo_contrast": 0.03,
            "dunes": Dunes(wavelength_m=34.0, height_m=1.2, wind_from_deg=290.0, crest_length=1.8, regularity=0.9),
            "ripples": Dunes(
                wavelength_m=0.3, height_m=0.015, wind_from_deg=285.0, repose_deg=20.0, crest_length=3.0, regularity=1.5
            ),
        }
    ),
)

IVANPAH = Site(
    name="ivanpah",
    description="Ivanpah dry lake, California and Nevada: an almost flat playa between alluvial fans",
    environment=MOJAVE,
    photometry=SitePhotometry(lunar_share=0.3, surge_amplitude=0.3, surge_width=0.05, rock_albedo=0.25),
    ground_texture=texture(3.0, 0.001, 0.03, decay=1.22),
    rock_texture=texture(0.2, 0.001, 0.1, decay=1.1),
    descent=TerrainParameters(
        hurst=0.8,
        rms_slope_deg=0.95,
        slope_baseline_m=90.0,
        outer_scale_m=1000.0,
        craters_per_km2=0.0,
        albedo=0.4,
        albedo_contrast=0.04,
        fans=Fans(polygons=Playa()),
    ),
    ground=ROVER_GROUND.model_copy(
        update={
            "rms_slope_deg": 0.3,
            "craters_per_km2": 0.0,
            "albedo": 0.4,
            "albedo_contrast": 0.04,
            "playa": Playa(polygon_m=0.45, fissure_m=0.04, fissure_depth_m=0.012, contrast=-0.25),
        }
    ),
)

GUSEV = Site(
    name="gusev",
    description="Gusev crater, Mars: cratered volcanic plains of the Spirit landing site",
    environment=MARS,
    photometry=SitePhotometry(rock_albedo=0.16, source=MARS_LAW),
    ground_texture=texture(3.0, 0.001, 0.035, decay=1.33),
    rock_texture=texture(0.2, 0.001, 0.16, decay=1.1),
    descent=TerrainParameters(
        hurst=0.75,
        rms_slope_deg=1.7,
        craters_per_km2=180.0,
        crater_diameter_min_m=8.0,
        albedo=0.22,
        albedo_contrast=0.11,
        albedo_hurst=-0.15,
        # share covered by rocks at Spirit's landing site, 7 % (Golombek et al. 2006)
        rocks=RockParameters(abundance=0.07, smallest_m=1.0),
    ),
    ground=ROVER_GROUND.model_copy(
        update={
            "albedo": 0.22,
            "ripples": Dunes(
                wavelength_m=0.6, height_m=0.02, wind_from_deg=330.0, repose_deg=18.0, crest_length=2.0, regularity=1.0
            ),
            "rocks": RockParameters(abundance=0.07),
        }
    ),
)

MERIDIANI = Site(
    name="meridiani",
    description="Meridiani Planum, Mars: dark, level plains of ripples, nearly without rocks; Opportunity's site",
    environment=MARS,
    photometry=SitePhotometry(rock_albedo=0.25, source=MARS_LAW),
    ground_texture=texture(3.0, 0.001, 0.03, decay=1.34),
    rock_texture=texture(0.2, 0.001, 0.14, decay=1.1),
    descent=TerrainParameters(
        hurst=0.8,
        rms_slope_deg=1.8,
        craters_per_km2=56.0,
        crater_diameter_min_m=8.0,
        albedo=0.14,
        albedo_contrast=0.1,
        albedo_hurst=-0.15,
    ),
    ground=ROVER_GROUND.model_copy(
        update={
            "rms_slope_deg": 1.5,
            "craters_per_km2": 300.0,
            "albedo": 0.14,
            "dunes": Dunes(
                wavelength_m=2.4, height_m=0.09, wind_from_deg=100.0, repose_deg=20.0, crest_length=4.0, regularity=1.5
            ),
            "ripples": Dunes(wavelength_m=0.25, height_m=0.01, wind_from_deg=60.0, repose_deg=20.0, crest_length=3.0),
            "rocks": RockParameters(abundance=0.01, smallest_m=0.03),
        }
    ),
)

MARS_YARD = Site(
    name="mars-yard",
    description="The Jet Propulsion Laboratory's outdoor Mars Yard: level sand and gravel with rocks",
    environment=PASADENA,
    photometry=SitePhotometry(lunar_share=0.4, surge_amplitude=0.4, surge_width=0.06, rock_albedo=0.2),
    ground_texture=texture(3.0, 0.001, 0.04, decay=1.32),
    rock_texture=texture(0.2, 0.001, 0.17, decay=1.1),
    ground=ROVER_GROUND.model_copy(
        update={
            "rms_slope_deg": 2.0,
            "outer_scale_m": 8.0,
            "craters_per_km2": 0.0,
            "albedo": 0.28,
            "rocks": RockParameters(abundance=0.06, largest_m=1.2),
        }
    ),
)

HELI_BENIGN = Site(
    name="heli-benign",
    description="Helicopter landing tests, benign: gentle ground with few small rocks",
    environment=PASADENA,
    photometry=SitePhotometry(lunar_share=0.4, surge_amplitude=0.4, surge_width=0.06, rock_albedo=0.22),
    ground_texture=texture(3.0, 0.001, 0.05, decay=1.28),
    rock_texture=texture(0.2, 0.001, 0.17, decay=1.1),
    ground=HELICOPTER_GROUND.model_copy(
        update={"rms_slope_deg": 2.0, "rocks": RockParameters(abundance=0.01, smallest_m=0.08, largest_m=0.6)}
    ),
)

HELI_HAZARDOUS = Site(
    name="heli-hazardous",
    description="Helicopter landing tests, hazardous: rocks, slopes and gullies",
    environment=PASADENA,
    photometry=SitePhotometry(lunar_share=0.4, surge_amplitude=0.4, surge_width=0.06, rock_albedo=0.22),
    ground_texture=texture(3.0, 0.001, 0.05, decay=1.28),
    rock_texture=texture(0.2, 0.001, 0.17, decay=1.1),
    ground=HELICOPTER_GROUND.model_copy(
        update={
            "rms_slope_deg": 6.0,
            "slope_baseline_m": 5.0,
            "outer_scale_m": 60.0,
            "hurst": 0.9,
            "gullies": Gullies(per_km2=500.0, length_m=70.0, width_m=5.0),
            "rocks": RockParameters(abundance=0.08, smallest_m=0.08, largest_m=2.5),
        }
    ),
)

PRESETS = (PISGAH, KELSO, IVANPAH, GUSEV, MERIDIANI, MARS_YARD, HELI_BENIGN, HELI_HAZARDOUS)
