# syntax=docker/dockerfile:1
# Two stages: the first installs into /opt/sprung, the second holds only that and an interpreter.
# the base by its digest (of all platforms); a newer one: docker buildx imagetools inspect python:3.11-slim-bookworm
ARG BASE=python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b
FROM ${BASE} AS build
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
WORKDIR /src
COPY requirements.lock requirements.hashes.lock ./
RUN python3 -m venv /opt/sprung
RUN /opt/sprung/bin/pip install --no-cache-dir --extra-index-url "$TORCH_INDEX" "$(grep '^torch==' requirements.lock)"
RUN /opt/sprung/bin/pip install --no-cache-dir --no-deps --require-hashes -r requirements.hashes.lock
COPY pyproject.toml README.md ./
COPY sprung ./sprung
COPY model ./model
COPY replay ./replay
COPY service ./service
COPY benchmarks ./benchmarks
RUN /opt/sprung/bin/pip install --no-cache-dir --no-deps .

FROM ${BASE}
RUN useradd --system --uid 10001 --home-dir /var/lib/sprung --create-home sprung
COPY --from=build /opt/sprung /opt/sprung
# the root file system may be read-only: everything that changes is in the volume and in /tmp
ENV PATH=/opt/sprung/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    MPLCONFIGDIR=/tmp/matplotlib \
    SPRUNG_HOST=0.0.0.0 \
    SPRUNG_PORT=8000 \
    SPRUNG_DATA_DIR=/var/lib/sprung
USER sprung
WORKDIR /var/lib/sprung
VOLUME /var/lib/sprung
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=15s --timeout=5s --start-period=30s \
    CMD ["python3", "-c", "import os, urllib.request as r; r.urlopen(f'http://127.0.0.1:{os.environ[\"SPRUNG_PORT\"]}/health/ready', timeout=4)"]
CMD ["sprung", "serve"]
