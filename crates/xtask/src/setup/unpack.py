"""Copies members of wheels to where rules say: DESTINATION [[PATTERN, STRIP or null, INTO], ...] WHEEL..."""

import fnmatch
import json
import os
import shutil
import sys
import zipfile

destination, rules, *wheels = sys.argv[1:]
rules = json.loads(rules)
for wheel in wheels:
    with zipfile.ZipFile(wheel) as archive:
        for member in archive.namelist():
            if member.endswith("/") or ".." in member.split("/"):
                continue
            for pattern, strip, into in rules:
                if fnmatch.fnmatchcase(member, pattern):
                    break
            else:
                continue
            name = os.path.basename(member) if strip is None else member[len(strip):]
            target = os.path.join(destination, into, name)
            os.makedirs(os.path.dirname(target), exist_ok=True)
            with archive.open(member) as source, open(target, "wb") as sink:
                shutil.copyfileobj(source, sink, 1 << 20)
