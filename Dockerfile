# syntax=docker/dockerfile:1
# Two stages: one with the tools to build, one with what runs. Compiled kernels are made at build
# time for a generic processor, so that the image starts at once on any machine of its kind.
ARG PYTHON=3.13
FROM python:${PYTHON}-slim AS build
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/stillpath
WORKDIR /src
COPY requirements.lock ./
RUN /opt/stillpath/bin/pip install --require-hashes -r requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY models models
COPY gcode gcode
COPY simulation simulation
COPY compensation compensation
COPY service service
COPY integrations/slicers integrations/slicers
RUN python -m pip wheel --no-deps --wheel-dir /dist . \
    && /opt/stillpath/bin/pip install --no-deps /dist/stillpath-*.whl
COPY examples/ps_ender3_pauses_hept24f.gcode /src/warm.gcode
# The cache is tied to where the modules lie and when they were written: warm it in its final
# place, with the settings it will be read with.
ENV NUMBA_CPU_NAME=generic NUMBA_CACHE_DIR=/opt/stillpath/numba PYTHONSAFEPATH=1
RUN /opt/stillpath/bin/stillpath compensate /src/warm.gcode -o /tmp/warm.gcode --machine ender3 \
    && rm /tmp/warm.gcode

FROM python:${PYTHON}-slim
LABEL org.opencontainers.image.title="Stillpath" \
      org.opencontainers.image.licenses="Apache-2.0"
RUN useradd --system --uid 10001 --create-home stillpath \
    && install -d -o stillpath -g stillpath /data
COPY --from=build --chown=stillpath:stillpath /opt/stillpath /opt/stillpath
ENV PATH=/opt/stillpath/bin:$PATH \
    NUMBA_CPU_NAME=generic \
    NUMBA_CACHE_DIR=/opt/stillpath/numba \
    OPENBLAS_NUM_THREADS=1 \
    OMP_NUM_THREADS=1 \
    PYTHONSAFEPATH=1 \
    PYTHONUNBUFFERED=1 \
    STILLPATH_DATA_DIR=/data
USER stillpath
WORKDIR /data
VOLUME /data
EXPOSE 8000
HEALTHCHECK --interval=30s --timeout=5s --start-period=20s \
    CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8000/readyz', timeout=4)"]
# Inside the container every address is the container's own; publish the port on loopback only
# (compose.yaml does), or put something before it that checks who is calling.
CMD ["stillpath", "serve", "--host", "0.0.0.0", "--port", "8000", "--allow-remote"]
