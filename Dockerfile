# Two images. runtime: agent, server, link, and the verbs about fields and certificates. full: training
# and evaluation too. Versions and hashes are those of requirements/. `make images` builds both, from
# wheels that it collects on the host in build/wheels; where these are missing the build collects and
# compiles them itself.
ARG BASE=debian:bookworm-slim
FROM ${BASE} AS python
RUN apt-get update \
	&& apt-get install -y --no-install-recommends python3 \
	&& rm -rf /var/lib/apt/lists/* /var/cache/apt/*

FROM python AS source
COPY . /src
WORKDIR /src

FROM source AS runtime-packages
ARG PIP_INDEX_URL
ARG PIP_EXTRA_INDEX_URL
RUN test -d build/wheels/runtime || deploy/wheelhouse-in-image.sh runtime
RUN python3 -m venv --without-pip /opt/rfedge \
	&& PYTHONPATH=$(echo build/wheels/runtime/pip/pip-*.whl) /opt/rfedge/bin/python -m pip install -q \
		--no-index --no-deps --root-user-action ignore build/wheels/runtime/*.whl

FROM python AS runtime
COPY deploy/healthy.sh /usr/local/bin/healthy
# Volumes mounted here for the first time belong to the user that the services run as.
RUN useradd --uid 10001 --no-create-home --home-dir /nonexistent rfedge \
	&& install -d -o rfedge -g rfedge /fields /certs /cache /pictures /keys \
		/keys/rsu /keys/watch /keys/twin /keys/cav-1 /keys/cav-2 /keys/cav-3 /keys/cav-4
COPY --from=runtime-packages /opt/rfedge /opt/rfedge
ENV PATH=/opt/rfedge/bin:$PATH PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1
USER rfedge
CMD ["rfedge", "--help"]

FROM source AS full-packages
ARG PIP_INDEX_URL
ARG PIP_EXTRA_INDEX_URL
RUN test -d build/wheels/full || deploy/wheelhouse-in-image.sh full
RUN python3 -m venv --without-pip /opt/rfedge \
	&& PYTHONPATH=$(echo build/wheels/full/pip/pip-*.whl) /opt/rfedge/bin/python -m pip install -q \
		--no-index --no-deps --root-user-action ignore build/wheels/full/*.whl

FROM python AS full
COPY deploy/healthy.sh /usr/local/bin/healthy
RUN useradd --uid 10001 --create-home rfedge \
	&& install -d -o rfedge -g rfedge /fields /certs /cache /work
COPY --from=full-packages /opt/rfedge /opt/rfedge
ENV PATH=/opt/rfedge/bin:$PATH PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1
USER rfedge
WORKDIR /work
CMD ["rfedge", "--help"]
