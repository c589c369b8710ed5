"""Copies the headers and the named libraries out of wheels: DESTINATION NAME,NAME,... WHEEL..."""

import os
import shutil
import sys
import zipfile

destination, names, *wheels = sys.argv[1:]
names = set(names.split(","))
for wheel in wheels:
    with zipfile.ZipFile(wheel) as archive:
        for member in archive.namelist():
            name = os.path.basename(member)
            if member.endswith("/") or ".." in member.split("/"):
                continue
            if member.startswith("torch/include/"):
                target = os.path.join(destination, member[len("torch/"):])
            elif name in names:
                target = os.path.join(destination, "lib", name)
            else:
                continue
            os.makedirs(os.path.dirname(target), exist_ok=True)
            with archive.open(member) as source, open(target, "wb") as sink:
                shutil.copyfileobj(source, sink, 1 << 20)
