"""OpenSSH signatures of a file, made and checked by `ssh-keygen` with a key of the user."""

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from marsyard.campaigns.errors import CampaignError

#: Namespace of the signatures: a signature for another purpose is not valid here.
NAMESPACE = "marsyard-assurance"
#: Ending of the file of a signature (ssh-keygen(1)), and time limit of one call, s: the user may type a passphrase.
_ENDING, _TIMEOUT_S = ".sig", 120.0


def signature_path(path: Path) -> Path:
    """Return the file of the signature of a file."""
    return path.with_name(path.name + _ENDING)


def check_key(key: Path) -> None:
    """Raise CampaignError if a key does not exist."""
    if not key.is_file():
        raise CampaignError(f"--sign {key}: no such file; `ssh-keygen -t ed25519 -f {key}` creates a key")


def sign_file(path: Path, key: Path) -> None:
    """Sign a file with a private key, or with a public key whose private key is in the agent. Raises CampaignError."""
    signature_path(path).unlink(missing_ok=True)
    process = _run(["sign", "-f", str(key), "-n", NAMESPACE, str(path)])
    if process.returncode or not signature_path(path).is_file():
        raise CampaignError(f"--sign {key}: {_last_line(process)}")


def check_signature(path: Path, signers: Path | None) -> tuple[bool, str]:
    """Check the signature of a file; return whether it is valid, and a description of the signer or of the problem.

    signers: file of allowed signers (ssh-keygen(1)); None to accept any key. Raises CampaignError without `ssh-keygen`.
    """
    signature, content = str(signature_path(path)), path.read_bytes()
    if signers is None:
        process = _run(["check-novalidate", "-n", NAMESPACE, "-s", signature], content)
        return not process.returncode, _last_line(process)
    if not signers.is_file():
        raise CampaignError(f"--signers {signers}: no such file")
    principals = _run(["find-principals", "-s", signature, "-f", str(signers)])
    if principals.returncode:
        return False, f"the key of the signature is not in {signers}"
    name = principals.stdout.decode(errors="replace").split("\n")[0].split(",")[0].strip()
    arguments = ["verify", "-f", str(signers), "-I", name, "-n", NAMESPACE, "-s", signature]
    process = _run(arguments, content)
    return not process.returncode, _last_line(process)


def _run(arguments: Sequence[str], content: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    """Run ``ssh-keygen -Y`` with an input. Raises CampaignError if it is not installed or does not end."""
    program = shutil.which("ssh-keygen")
    if program is None:
        raise CampaignError("signatures need ssh-keygen; install OpenSSH (Debian: apt install openssh-client)")
    try:
        # ssh-keygen asks for a passphrase on the terminal itself
        return subprocess.run(  # noqa: S603
            [program, "-Y", *arguments], input=content, capture_output=True, timeout=_TIMEOUT_S, check=False
        )
    except subprocess.SubprocessError as error:
        raise CampaignError(f"ssh-keygen did not end: {error}") from error


def _last_line(process: subprocess.CompletedProcess[bytes]) -> str:
    """Return the last line that the program has printed."""
    lines = (process.stdout + process.stderr).decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else f"exit status {process.returncode}"
