"""Streams (`marsyard.algorithms.interface.ImageStream`) as programs: requests, and a server for Python streams."""

import json
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import TextIOBase
from pathlib import Path
from typing import Any, Generic, TypeVar

from marsyard.algorithms.exchange.executable import Request
from marsyard.algorithms.exchange.files import EXCHANGE_VERSION, read_frame, write_frame
from marsyard.algorithms.exchange.forms import VELOCITY_FORM, AnswerForm, ProgramDetails, check_keys
from marsyard.algorithms.exchange.values import decode, encode
from marsyard.algorithms.faults import bad_answer
from marsyard.sim.measurements import AltitudeMeasurement, ImuIncrements

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class StreamForm(Generic[Answer]):
    """Exchange of a task's streams with programs: what is written, and what is read.

    - answer: form of the answers
    - write_image, read_image: write an image with its measurements into an existing folder, and read it
    - encode_start, read_start: values of the request `start` from the arguments of the method, and the arguments from
      the request
    """

    answer: AnswerForm[Answer]
    write_image: Callable[[Path, Any], None]
    read_image: Callable[[Path], Any]
    encode_start: Callable[..., Mapping[str, Any]] = dict
    read_start: Callable[[Mapping[str, Any]], tuple[Any, ...]] = lambda _: ()

    @property
    def requests(self) -> Mapping[str, Request]:
        """Requests of a program, by the method of the stream."""
        return {
            "start": Request(self.encode_start, _read_null),
            "process_increments": Request(lambda item: {"increments": encode(item)}, _read_null),
            "process_altitude": Request(lambda item: {"altitude": encode(item)}, _read_null),
            "process_image": Request(
                lambda image: {"image": lambda folder: self.write_image(folder, image)}, self._read_optional
            ),
            "finish": Request(dict, self.answer.read),
        }

    def _read_optional(self, answer: Mapping[str, Any], details: ProgramDetails, _image: Any) -> Answer | None:
        """Decode the answer to an image; None for the outcome null."""
        if answer.get("outcome", "") is not None:
            return self.answer.read(answer, details)
        check_keys(answer, {"outcome"})
        return None

    def serve(self, stream: Any, requests: Iterable[str] | None = None, answers: TextIOBase | None = None) -> None:
        """Answer the requests on standard input with a Python stream, one line each, until the input ends.

        `requests` and `answers` replace standard input and output. The stream's own output goes to standard error. Its
        exceptions end the program.
        """
        output = sys.stdout if answers is None else answers
        print(json.dumps({"exchange": EXCHANGE_VERSION, "ready": True}), file=output, flush=True)
        with redirect_stdout(sys.stderr):
            for line in sys.stdin if requests is None else requests:
                request = json.loads(line)
                answer = self.answer.encode(self._call(stream, request))
                answer_line = json.dumps({"exchange": EXCHANGE_VERSION, "id": request["id"], **answer})
                print(answer_line, file=output, flush=True)

    def _call(self, stream: Any, request: Mapping[str, Any]) -> Answer | None:
        """Call the stream's method of a request, if it has it. Raises ValueError for an unknown request."""
        readers: Mapping[str, Callable[[], tuple[Any, ...]]] = {
            "start": lambda: self.read_start(request),
            "process_increments": lambda: (decode(ImuIncrements, request["increments"]),),
            "process_altitude": lambda: (decode(AltitudeMeasurement, request["altitude"]),),
            "process_image": lambda: (self.read_image(Path(request["image"])),),
            "finish": lambda: (),
        }
        if request["do"] not in readers:
            raise ValueError(f"unknown request '{request['do']}'; allowed: {', '.join(readers)}")
        method: Callable[..., Answer | None] | None = getattr(stream, request["do"], None)
        return None if method is None else method(*readers[request["do"]]())


def _read_null(answer: Mapping[str, Any], _details: ProgramDetails, *_arguments: Any) -> None:
    """Check the answer to a request that expects no estimate."""
    check_keys(answer, {"outcome"})
    if answer.get("outcome", "") is not None:
        allowed = "only process_image and finish have an outcome; allowed: null"
        raise bad_answer(f"outcome is {answer.get('outcome')!r}; {allowed}")


#: Exchange of velocity streams.
VELOCITY_STREAM = StreamForm(VELOCITY_FORM, write_frame, read_frame)
