"""A velocity estimator with a neural network: it selects the matches from which the velocity is computed.

    marsyard run dimes-smoke --algorithm velocity_network.estimator:NetworkEstimator --algorithm dimes

The network is the file `network.onnx` next to this module; `train.py` writes it. Each worker constructs the
estimator once, in a process of its own, and gives it a device: `cpu`, or `cuda:0` for the first GPU.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnxruntime

from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements
from velocity_network.matches import find_matches, network_inputs

#: Not in the current folder: the process of an algorithm has a folder of its own.
NETWORK = Path(__file__).with_name("network.onnx")
#: Minimum probability that a match is right.
MIN_PROBABILITY = 0.9
#: Minimum number of selected matches.
MIN_MATCHES = 5
#: Maximum GPU memory for the weights and activations of one worker, bytes.
GPU_MEMORY_BYTES = 1 << 30


class NetworkEstimator:
    """Estimator that follows `marsyard.algorithms.interface.VelocityEstimator`."""

    #: Reports identify the network by this hash, because the hash of the source code does not include it.
    options = {"network_sha256": hashlib.sha256(NETWORK.read_bytes()).hexdigest()}  # noqa: RUF012

    def __init__(self, device: str = "cpu") -> None:
        """Load the network; `device` is `cpu` or `cuda:N`."""
        self._session = create_session(NETWORK, device)

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Return the median velocity of the selected matches."""
        return self.estimate_batch([measurements])[0]

    def estimate_batch(self, cases: Sequence[DescentMeasurements]) -> list[VelocityEstimate]:
        """Answer several cases with one call of the network."""
        matches = [find_matches(measurements) for measurements in cases]
        inputs = np.concatenate([network_inputs(found) for found in matches])
        # some providers reject an empty batch
        probabilities = self._session.run(None, {"matches": inputs})[0][:, 0] if len(inputs) else np.zeros(0)
        ends = np.cumsum([len(found.velocities_m_s) for found in matches])
        parts = np.split(probabilities, ends[:-1])
        return [_select(found.velocities_m_s, part) for found, part in zip(matches, parts, strict=True)]


def _select(velocities_m_s: np.ndarray, probabilities: np.ndarray) -> VelocityEstimate:
    """Return the median of the velocities with a high probability."""
    selected = velocities_m_s[probabilities >= MIN_PROBABILITY]
    if len(selected) < MIN_MATCHES:
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
    return VelocityEstimate(VelocityOutcome.VALID, np.median(selected, axis=0))


def create_session(network: Path, device: str) -> onnxruntime.InferenceSession:
    """Load a network on a device. Raises RuntimeError if the device is not available.

    ONNX Runtime itself would continue on the CPU, and the campaign would measure another algorithm.
    """
    options = onnxruntime.SessionOptions()
    # one core per worker: the cores belong to the other workers
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    kind, _, number = device.partition(":")
    if kind == "cpu":
        return onnxruntime.InferenceSession(network, options, providers=["CPUExecutionProvider"])
    if kind != "cuda" or not number.isdecimal():
        raise RuntimeError(f"the device is {device}; allowed: cpu, cuda:0, cuda:1, ...")
    provider = "CUDAExecutionProvider"
    if provider not in onnxruntime.get_available_providers():
        raise RuntimeError(f"no {device}: install onnxruntime-gpu instead of onnxruntime")
    provider_options = {
        "device_id": number,
        "gpu_mem_limit": str(GPU_MEMORY_BYTES),
        "arena_extend_strategy": "kSameAsRequested",  # by default the memory grows to powers of two
        "use_tf32": "0",  # by default products are rounded to 10 bits
    }
    session = onnxruntime.InferenceSession(network, options, providers=[(provider, provider_options)])
    if provider not in session.get_providers():
        raise RuntimeError(f"no {device}: ONNX Runtime cannot use it; its messages are in standard error")
    return session
