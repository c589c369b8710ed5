"""Validates the YAML documents of stdin against the strict schemas of each Kubernetes VERSION... given.

Prints JSON: the documents as `objects`, and as `problems` what the schemas refuse, unknown fields included.
"""

import functools
import json
import sys

import kubernetes_validate
from kubernetes_validate import utils
import yaml

# Else the definitions, 2 MB, are parsed for every document.
utils.schema_contents = functools.lru_cache(maxsize=None)(utils.schema_contents)


def name(document):
    return f"{document.get('kind')} {document.get('metadata', {}).get('name')}"


objects = [document for document in yaml.safe_load_all(sys.stdin) if document is not None]
problems = []
for document in objects:
    for version in sys.argv[1:]:
        try:
            kubernetes_validate.validate(document, version, strict=True)
        except kubernetes_validate.ValidationError as error:
            place = ".".join(str(step) for step in error.path)
            problems.append(f"{name(document)}: {place or 'top'}: {error.message} (Kubernetes {version})")
        except kubernetes_validate.SchemaNotFoundError as error:
            problems.append(f"{name(document)}: {error.message}")
json.dump({"objects": objects, "problems": problems}, sys.stdout)
