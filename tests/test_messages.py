"""Errors carry as data what code needs of them: nothing looks into the words of our own."""

import ast
from collections.abc import Iterator

import pytest

from tests.test_floors import modules

WORDS = {"detail", "message", "problem", "reason", "title"}  # attributes that are for people
LOOKS_INTO = {"endswith", "find", "findall", "fullmatch", "index", "match", "partition"} | {
    *("removeprefix", "removesuffix", "replace", "rpartition", "rsplit", "search", "split"),
    *("startswith", "sub"),
}
OF_OTHERS = {
    "worker.contract": "Redis gives no more than a text",
    "service.http.errors": "Starlette gives the status's phrase where there is no detail",
    "fewview.readers.archives": "libraries' messages may name the folder that was unpacked into",
}


def test_no_code_looks_into_the_words_of_our_errors() -> None:
    found = {name for name, path in modules().items() if any(looks(path.read_text()))}
    assert found == set(OF_OTHERS)


@pytest.mark.parametrize(
    "code",
    [
        "PATTERN.search(str(error))",
        "'no frame' in str(error)",
        "error.detail == 'gone'",
        "error.problem.removeprefix('a: ')",
        "f'{error}'.split(':')",
    ],
)
def test_looks_into_words_are_noticed(code: str) -> None:
    assert any(looks(f"try: pass\nexcept ValueError as error: {code}"))
    assert any(looks(f"def _of(error: FormatError) -> None: {code}"))


def looks(text: str) -> Iterator[ast.expr]:
    """Yield the expressions of a module that compare or take apart what an error says."""
    nodes = list(ast.walk(ast.parse(text)))
    errors = {node.name for node in nodes if isinstance(node, ast.ExceptHandler)}
    errors |= {
        node.arg
        for node in nodes
        if isinstance(node, ast.arg) and node.annotation is not None
        if ast.unparse(node.annotation).endswith(("Error", "Exception"))
    }
    for node in nodes:
        if isinstance(node, ast.Compare):
            seen = [node.left, *node.comparators]
        elif (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in LOOKS_INTO
        ):
            seen = [*node.args, *([node.func.value] if node.args else [])]
        else:
            continue
        if any(_is_words(each, errors) for each in seen):
            yield node


def _is_words(node: ast.expr, errors: set[str | None]) -> bool:
    if isinstance(node, ast.Attribute):
        return node.attr in WORDS and isinstance(node.value, ast.Name) and node.value.id in errors
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "str":
        return any(isinstance(each, ast.Name) and each.id in errors for each in node.args)
    return isinstance(node, ast.JoinedStr) and any(
        isinstance(part, ast.FormattedValue)
        and isinstance(part.value, ast.Name)
        and part.value.id in errors
        for part in node.values
    )
