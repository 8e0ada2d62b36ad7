"""Part of a study in the record of its folder (`campaign.json`): its parameters and result, as data classes."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import TypeAdapter, ValidationError

from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.store import record

#: Key of a study's parameters and results in the record of its folder.
STUDY_KEY = "study"

Parameters = TypeVar("Parameters")
Result = TypeVar("Result")


@dataclass(frozen=True)
class StudyKind(Generic[Parameters, Result]):
    """A kind of study.

    - name: value of the key `kind`
    - title: noun phrase for messages
    - parameters, result: data classes of its parameters and of its result
    """

    name: str
    title: str
    parameters: type[Parameters]
    result: type[Result]

    def encode(self, parameters: Any) -> dict[str, Any]:
        """Encode parameters for the record."""
        return {"kind": self.name, **asdict(parameters)}

    def read(self, content: Mapping[str, Any]) -> tuple[Parameters, Result] | None:
        """Read parameters and result from a record; None for another run, or an unfinished study."""
        study = content.get(STUDY_KEY)
        if not isinstance(study, Mapping) or study.get("kind") != self.name or not study.get("result"):
            return None
        return self._decode_parameters(study), _decode(self.result, study["result"])

    def read_parameters(self, directory: Path) -> Parameters:
        """Read the parameters of the study in a folder. Raises CampaignError if it contains no study of this kind."""
        study = read_study(directory) or {}
        if study.get("kind") != self.name:
            raise CampaignError(f"{directory} does not contain {self.title}")
        return self._decode_parameters(study)

    def _decode_parameters(self, study: Mapping[str, Any]) -> Parameters:
        return _decode(
            self.parameters, {name: value for name, value in study.items() if name not in ("kind", "result")}
        )


def _decode(kind: type[Result], content: Any) -> Result:
    """Decode a data class. Raises StoreError for invalid content."""
    try:
        return TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        raise StoreError(f"the study in {record.RECORD_FILE} is damaged: {error.errors()[0]['msg']}") from error


def read_study(directory: Path) -> dict[str, Any] | None:
    """Read the parameters and results of a study from the record of its folder; None for an ordinary campaign."""
    study = record.read(directory).get(STUDY_KEY)
    return study if isinstance(study, dict) else None
