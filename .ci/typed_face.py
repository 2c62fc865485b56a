"""Whether a type checker knows the type of everything that ``import legdistort`` offers; prints what it does not.

Needs pyright. What astropy leaves without types is none of ours: `LegdistortWarning` is one of its warnings.
"""

import json
import subprocess
import sys

import legdistort

command = [sys.executable, "-m", "pyright", "--verifytypes", "legdistort", "--ignoreexternal", "--outputjson"]
found = json.loads(subprocess.run(command, capture_output=True, text=True, check=False).stdout)
face = {f"legdistort.{module}.{name}" for name, module in legdistort._PLACES.items()} - {
    "legdistort.exceptions.LegdistortWarning"
}
known, unknown = 0, []
for symbol in found["typeCompleteness"]["symbols"]:
    name = symbol["name"]
    if not any(name == each or name.startswith(f"{each}.") for each in face):
        continue
    known += symbol["isTypeKnown"]
    if not symbol["isTypeKnown"]:
        unknown.append(": ".join([name, *(d["message"] for d in symbol.get("diagnostics", []))]))
print("\n".join([*unknown, f"{known} of {known + len(unknown)} types of the public face are known"]))
sys.exit(bool(unknown) or known < len(face))
