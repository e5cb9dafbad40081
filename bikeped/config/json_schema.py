"""The JSON Schema of config.yaml, with the descriptions of its keys, from `config/schema.py`."""

from __future__ import annotations

import ast
import inspect
from typing import Any

import msgspec

from bikeped.config.schema import Config, sections


def json_schema() -> dict[str, Any]:
    """The JSON Schema of config.yaml, every key with its description."""
    schema = msgspec.json.schema(Config)
    for _, section in sections(Config):
        properties = schema["$defs"][section.__name__]["properties"]
        for key, text in key_descriptions(section).items():
            properties[key]["description"] = text
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def key_descriptions(section: type[msgspec.Struct]) -> dict[str, str]:
    """What each key of a section means: the text below it in the source."""
    [tree] = ast.parse(inspect.getsource(section)).body
    assert isinstance(tree, ast.ClassDef)  # noqa: S101 - for the type checker
    return {
        ast.unparse(key.target): " ".join(ast.literal_eval(text.value).split())
        for key, text in zip(tree.body, tree.body[1:], strict=False)
        if isinstance(key, ast.AnnAssign) and isinstance(text, ast.Expr)
    }
