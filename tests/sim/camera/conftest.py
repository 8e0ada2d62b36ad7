"""Fixtures of the camera tests: Opportunity's cameras with the values of their PDS labels."""

import numpy as np
import pytest

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel


def _make_navcam_376() -> Cahvor:
    """Return the left navcam as labelled in 1N491020376ILFCNY9P0706L0M1."""
    return Cahvor(
        c=np.array([0.442604, -0.0611635, -1.25106]),
        a=np.array([0.93995, -0.338133, 0.0464979]),
        h=np.array([884.72, 981.763, 24.1472]),
        v=np.array([418.579, -152.039, 1245.75]),
        o=np.array([0.946551, -0.315595, 0.0666419]),
        r=np.array([0.00096, -0.002183, 0.018547]),
        size=(1024, 1024),
    )


def _make_navcam_519() -> Cahvor:
    """Return the left navcam as labelled in 1N491020519ILFCNY9P0706L0M1."""
    return Cahvor(
        c=np.array([0.508813, -0.0504884, -1.24881]),
        a=np.array([0.958735, 0.244186, 0.145611]),
        h=np.array([177.872, 1307.64, 74.9286]),
        v=np.array([309.988, 76.3239, 1283.86]),
        o=np.array([0.949642, 0.266041, 0.165536]),
        r=np.array([0.00096, -0.002183, 0.018547]),
        size=(1024, 1024),
    )


def _make_hazcam() -> Cahvore:
    """Return the left front hazcam as labelled in 1F483288473EFFCMUFP1214L0M1; model type 3."""
    return Cahvore(
        c=np.array([0.609331, -0.041064, -0.233849]),
        a=np.array([0.703447, -0.005161, 0.710729]),
        h=np.array([351.362, 452.204, 353.494]),
        v=np.array([35.8065, -1.75143, 682.705]),
        o=np.array([0.704402, -0.006062, 0.709775]),
        r=np.array([3e-06, -0.012015, -0.007525]),
        e=np.array([0.001442, 0.001522, 0.000483]),
        linearity=0.37,
        size=(1024, 1024),
    )


def _make_pinhole() -> Cahv:
    """Return the navcam without lens distortion."""
    navcam = _make_navcam_376()
    return Cahv(navcam.c, navcam.a, navcam.h, navcam.v, navcam.size)


@pytest.fixture
def navcam() -> Cahvor:
    return _make_navcam_376()


@pytest.fixture
def hazcam() -> Cahvore:
    return _make_hazcam()


@pytest.fixture
def pinhole() -> Cahv:
    return _make_pinhole()


@pytest.fixture
def labelled_cameras() -> dict[str, CameraModel]:
    """Return the cameras by product name."""
    return {
        "1N491020376ILFCNY9P0706L0M1.IMG": _make_navcam_376(),
        "1N491020519ILFCNY9P0706L0M1.IMG": _make_navcam_519(),
        "1F483288473EFFCMUFP1214L0M1.IMG": _make_hazcam(),
    }


@pytest.fixture(
    params=[_make_pinhole, _make_navcam_376, _make_navcam_519, _make_hazcam],
    ids=["cahv", "navcam", "navcam turned", "hazcam"],
)
def camera(request: pytest.FixtureRequest) -> CameraModel:
    model: CameraModel = request.param()
    return model
