#!/bin/bash
# Succeeds if the process answers on this port: healthy PORT [PATH]. Without a path, with its metrics.
# bash speaks TCP by itself; a Python for each check would cost more than the service.
set -eu
exec 3<>"/dev/tcp/127.0.0.1/$1"
printf 'GET %s HTTP/1.0\r\nHost: localhost\r\n\r\n' "${2:-/metrics}" >&3
if [ $# -gt 1 ]; then
	read -r status <&3
	[[ $status == HTTP/1.?\ 200* ]]
else
	grep -q '^rfedge_build_info' <&3
fi
