#!/usr/bin/env bash
# pynmea2 1.19.0: THS, the sentence in which many two-antenna receivers give the true heading and
# whether it is valid (NMEA 0183 since 3.01 in place of HDT), raises SentenceTypeError, as a damaged
# line raises another ParseError: who counts both as malformed loses the heading silently.
# HDT, which carries no validity, is parsed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pynmea2==1.19.0
"$folder/venv/bin/python" - <<'PY'
import pynmea2


def sentence(body):
    check = 0
    for letter in body:
        check ^= ord(letter)
    return f"${body}*{check:02X}"


assert float(pynmea2.parse(sentence("GNHDT,77.5,T"), check=True).heading) == 77.5
try:
    pynmea2.parse(sentence("GNTHS,77.5,A"), check=True)
except pynmea2.SentenceTypeError as error:
    print(f"{type(error).__name__}: {error}")
    assert isinstance(error, pynmea2.ParseError)
else:
    raise SystemExit("THS is parsed: changed")
PY
echo "as seen: pynmea2 1.19.0"
