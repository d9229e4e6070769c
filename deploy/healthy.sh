#!/bin/bash
# Succeeds if the process answers with its metrics on this port: healthy PORT
# bash speaks TCP by itself; a Python for each check would cost more than the service.
set -eu
exec 3<>"/dev/tcp/127.0.0.1/$1"
printf 'GET /metrics HTTP/1.0\r\n\r\n' >&3
grep -q '^rfedge_build_info' <&3
