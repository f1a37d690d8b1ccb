"""The TypeScript declaration of the API, from its models: `make types` runs this as a program."""

from collections.abc import Iterator
from typing import Any

from pydantic.json_schema import models_json_schema

from panolog.orchestrator.watch.dashboard.messages import MESSAGES
from panolog.orchestrator.watch.views.pages.shell import STATIC

FILE = STATIC / "shared" / "messages.d.ts"


def declaration() -> str:
    """The TypeScript declaration of all messages."""
    schema = models_json_schema([(model, "serialization") for model in MESSAGES])[1]
    head = "// Generated from orchestrator/watch/dashboard/messages.py by `make types`: do not edit."
    return (
        "\n\n".join([head, *(_declare(name, item) for name, item in sorted(schema["$defs"].items()))]) + "\n"
    )


def _declare(name: str, schema: dict[str, Any]) -> str:
    comment = f"/** {schema['description'].splitlines()[0]} */\n" if "description" in schema else ""
    if "enum" in schema:
        return f"{comment}export type {name} = {_type(schema)};"
    return "\n".join([f"{comment}export interface {name} {{", *_members(schema), "}"])


def _members(schema: dict[str, Any]) -> Iterator[str]:
    for name, member in schema.get("properties", {}).items():
        yield f"  {name}: {_type(member)};"
    if schema.get("additionalProperties") is True:
        yield "  [name: string]: any;"


def _type(schema: dict[str, Any]) -> str:
    """The TypeScript type of a JSON schema."""
    text = str(schema.get("type", "any"))
    match schema:
        case {"$ref": path}:
            text = str(path).rpartition("/")[2]
        case {"anyOf": options}:
            text = " | ".join(dict.fromkeys(map(_type, options)))
        case {"const": value}:
            text = f'"{value}"'
        case {"enum": values}:
            text = " | ".join(f'"{value}"' for value in values)
        case {"type": "array", "prefixItems": items}:
            text = f"[{', '.join(map(_type, items))}]"
        case {"type": "array", "items": item}:
            text = f"Array<{_type(item)}>"
        case {"type": "object", "additionalProperties": dict(item)}:
            text = f"Record<string, {_type(item)}>"
        case {"type": "object"}:
            text = "Record<string, any>"
        case {"type": "integer"}:
            text = "number"
    return text


if __name__ == "__main__":
    FILE.write_text(declaration())
