"""Train the network of `estimator.py` on exported cases, and write `network.onnx`.

    marsyard export dimes-smoke -n 48 --seed 11 --set location.bank_seed=2 --out cases
    python -m velocity_network.train cases

The last quarter of the cases is held out: the network is not trained on it, and the printed figures are of these cases.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import onnx
import pandas as pd
from onnx import TensorProto, helper, numpy_helper
from sklearn.metrics import roc_auc_score
from sklearn.neural_network import MLPClassifier
from sklearn.preprocessing import StandardScaler

from marsyard.algorithms.exchange import read_case
from velocity_network.matches import find_matches, network_inputs

#: Maximum velocity error of a match that counts as right, m/s: the bound of the requirement.
MAX_ERROR_M_S = 5.0
#: Number of hidden units, and weight of the penalty on large weights.
HIDDEN_UNITS, PENALTY = 16, 1.0
#: Fraction of the right matches that is accepted when the wrong ones are counted.
ACCEPTED_FRACTION = 0.95
#: Version of the operators; every ONNX Runtime since 1.10 reads it.
OPERATORS = 15


def main() -> None:
    """Read the cases, train the network, print its figures and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", type=Path, help="folder of `marsyard export`; the truth is in CASES-truth")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("network.onnx"))
    arguments = parser.parse_args()

    inputs, is_right, cases = read_matches(arguments.cases)
    is_held_out = cases >= 0.75 * (cases.max() + 1)
    scaler, network = train(inputs[~is_held_out], is_right[~is_held_out])
    arguments.out.write_bytes(to_onnx(scaler, network).SerializeToString())
    for name, count in (("trained on", ~is_held_out), ("held out", is_held_out)):
        print(
            f"{name}: {count.sum()} matches of {len(np.unique(cases[count]))} cases, {is_right[count].mean():.0%} right"
        )
    inputs, is_right = inputs[is_held_out], is_right[is_held_out]
    print_figures("correlation", is_right, inputs[:, -2])
    print_figures("network", is_right, network.predict_proba(scaler.transform(inputs))[:, 1])
    print(f"written: {arguments.out.name}, {arguments.out.stat().st_size} bytes")


def read_matches(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the inputs of all matches, whether each is right, and its case."""
    truth = pd.read_parquet(folder.with_name(f"{folder.name}-truth") / "cases.parquet").set_index("case")
    inputs, is_right, cases = [], [], []
    for case_folder in sorted((folder / "cases").iterdir()):
        case = int(case_folder.name)
        matches = find_matches(read_case(case_folder))
        true_m_s = truth.loc[case, ["velocity_true_x_m_s", "velocity_true_y_m_s"]].to_numpy(float)
        inputs.append(network_inputs(matches))
        is_right.append(np.linalg.norm(matches.velocities_m_s - true_m_s, axis=1) <= MAX_ERROR_M_S)
        cases.append(np.full(len(matches.velocities_m_s), case))
    return np.concatenate(inputs), np.concatenate(is_right), np.concatenate(cases)


def train(inputs: np.ndarray, is_right: np.ndarray) -> tuple[StandardScaler, MLPClassifier]:
    """Train a network with one hidden layer that returns the probability of a right match."""
    scaler = StandardScaler().fit(inputs)
    network = MLPClassifier((HIDDEN_UNITS,), alpha=PENALTY, max_iter=1000, random_state=0)
    return scaler, network.fit(scaler.transform(inputs), is_right)


def to_onnx(scaler: StandardScaler, network: MLPClassifier) -> onnx.ModelProto:
    """Convert the network: two matrix products with `Relu` between them and `Sigmoid` at the end.

    The scaling of the inputs becomes part of the first product.
    """
    (first, second), (first_offset, second_offset) = network.coefs_, network.intercepts_
    first_offset = first_offset - (scaler.mean_ / scaler.scale_) @ first
    first = first / scaler.scale_[:, None]
    constants = {"first": first, "first_offset": first_offset, "second": second, "second_offset": second_offset}
    graph = helper.make_graph(
        [
            helper.make_node("Gemm", ["matches", "first", "first_offset"], ["products"]),
            helper.make_node("Relu", ["products"], ["hidden"]),
            helper.make_node("Gemm", ["hidden", "second", "second_offset"], ["log_odds"]),
            helper.make_node("Sigmoid", ["log_odds"], ["probabilities"]),
        ],
        "match_selection",
        # the name of the first dimension makes the size of a batch variable
        [helper.make_tensor_value_info("matches", TensorProto.FLOAT, ["n", len(first)])],
        [helper.make_tensor_value_info("probabilities", TensorProto.FLOAT, ["n", 1])],
        [numpy_helper.from_array(value.astype(np.float32), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPERATORS)], ir_version=8)
    onnx.checker.check_model(model)
    return model


def print_figures(name: str, is_right: np.ndarray, score: np.ndarray) -> None:
    """Print the area under the ROC curve, and the fraction of wrong matches if most right ones are accepted."""
    threshold = np.quantile(score[is_right], 1.0 - ACCEPTED_FRACTION)
    wrong = 1.0 - is_right[score >= threshold].mean()
    print(
        f"{name}: area under the ROC curve {roc_auc_score(is_right, score):.4f}, {wrong:.1%} of the accepted are wrong"
    )


if __name__ == "__main__":
    main()
