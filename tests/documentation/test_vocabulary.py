"""Tests that names, docstrings, comments and pages use the standard terms of the field.

The tables below map each rejected word to its standard term. docs/glossary.md defines the accepted terms.
"""

import ast
import io
import re
import subprocess
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("sim", "algorithms", "scenarios", "campaigns", "reports", "marsyard", "benchmarks", "tests")
#: Rejected words of names (split at underscores and capitals), with the standard term.
NAME_WORDS = {
    "most": "max",
    "least": "min",
    "told": "reported",
    "tells": "reports",
    "said": "stated",
    "thing": "object",
    "things": "objects",
    "whoever": "a noun",
    "anew": "again",
    "mend": "fix",
    "beside": "next to",
    "crew": "executor",
}
#: Patterns of accepted names, with the reason.
ALLOWED_NAMES = {r"least_(squares|median|absolute|sum)": "terms of estimation"}
#: Patterns of rejected text, with the replacement.
PHRASES = {
    r"\banew\b": "again",
    r"\bbeside\b": "next to",
    r"\bwhoever\b": "name the subject",
    r"\bwhatever\b": "name the subject",
    r"\bmends?\b": "fix",
    r"\btold\b": "reported, stated or given",
    r"\btells\b": "reports or states",
    r"\bthat which\b": "name the subject",
    r"\bof one's own\b": "custom",
    r"\bthings?\b": "object, body or mesh",
    r"\bgoes? on\b": "continue",
    r"\bcarr(?:y|ies) on\b": "continue",
    r"\b(?:filter|state)s? takes? in\b": "update",
}


#: Any rejected pattern, and any rejected word: most files have none, and do not have to be parsed.
ANY_PHRASE, ANY_WORD = (re.compile("|".join(words), re.IGNORECASE) for words in (PHRASES, NAME_WORDS))


def list_python_files() -> list[Path]:
    """List the Python files of packages, benchmarks and tests, by git."""
    result = subprocess.run(["git", "ls-files", *PACKAGES], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return [ROOT / name for name in result.stdout.split() if name.endswith(".py")]


def read_files(pattern: re.Pattern[str]) -> Iterator[tuple[Path, str]]:
    """Yield the Python files whose text contains a pattern, with their texts."""
    for path in list_python_files():
        text = path.read_text(encoding="utf-8")
        if pattern.search(text):
            yield path, text


def find_names(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield the names that a module defines (functions, classes, arguments, variables), with their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno


def split_name(name: str) -> list[str]:
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]


def find_prose(text: str) -> Iterator[tuple[str, int]]:
    """Yield the docstrings and comments of a module, with their lines."""
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else []:
            value = getattr(statement, "value", None)
            if isinstance(statement, ast.Expr) and isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield value.value, statement.lineno
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.string, token.start[0]


def find_violations(text: str, line: int) -> Iterator[str]:
    """Yield a message for each rejected pattern in a text that starts at a line; quoted code is ignored."""
    for number, text_line in enumerate(text.splitlines()):
        plain = re.sub(r"`[^`]*`", "", text_line)
        for pattern, replacement in PHRASES.items():
            if re.search(pattern, plain, re.IGNORECASE):
                yield f"{line + number}: {text_line.strip()[:80]!r}: use {replacement}"


def test_names_use_the_vocabulary() -> None:
    violations = [
        f"{path.relative_to(ROOT)}:{line}: {name} ({word}: use {NAME_WORDS[word]})"
        for path, file_text in read_files(ANY_WORD)
        for name, line in find_names(ast.parse(file_text))
        if not any(re.search(pattern, name) for pattern in ALLOWED_NAMES)
        for word in split_name(name)
        if word in NAME_WORDS
    ]
    assert not violations, "\n".join(violations)


def test_docstrings_and_comments_use_the_vocabulary() -> None:
    violations = [
        f"{path.relative_to(ROOT)}:{violation}"
        for path, file_text in read_files(ANY_PHRASE)
        for text, line in find_prose(file_text)
        for violation in find_violations(text, line)
    ]
    assert not violations, "\n".join(violations)


#: Pages of the documentation. Generated pages are excluded, because their texts are checked at their source.
PAGES = sorted(path for path in (ROOT / "docs").rglob("*.md") if "generated" not in path.parts)


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_use_the_vocabulary(page: Path) -> None:
    text = re.sub(
        r"^```.*?^```$", lambda block: "\n" * block[0].count("\n"), page.read_text(encoding="utf-8"), flags=re.M | re.S
    )
    assert not list(find_violations(text, 1))
