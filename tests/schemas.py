"""Results against the published JSON schema."""

import json
from importlib.resources import files

import jsonschema

SCHEMA = json.loads(files("btfref.validate").joinpath("schema.json").read_text("utf-8"))


def assert_follows_schema(data):
    jsonschema.Draft202012Validator(SCHEMA).validate(data)
