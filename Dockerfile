# syntax=docker/dockerfile:1
# Two stages: one with the tools to build, one with what runs. Compiled kernels are made at build
# time for a generic processor, so that the image starts at once on any machine of its kind.
# tests/test_image_steps.py takes these steps without an engine.
ARG PYTHON=3.13
FROM python:${PYTHON}-slim AS build
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/stillpath
WORKDIR /src
COPY requirements.lock ./
RUN /opt/stillpath/bin/pip install --require-hashes -r requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY src src
COPY models models
COPY gcode gcode
COPY compensation compensation
COPY simulation simulation
COPY pipeline pipeline
COPY reports reports
COPY applications applications
COPY service service
COPY cli cli
COPY docs docs
COPY integrations/slicers integrations/slicers
RUN python -m pip wheel --no-deps --wheel-dir /dist . \
    && /opt/stillpath/bin/pip install --no-deps /dist/stillpath-*.whl
COPY examples/ps_ender3_pauses_hept24f.gcode ./warm.gcode
COPY examples/firmware firmware
# The kernels are kept under the place where the modules lie: they are made in their final place.
ENV NUMBA_CPU_NAME=generic NUMBA_CACHE_DIR=/opt/stillpath/numba PYTHONSAFEPATH=1
# Those of every firmware: what is missing here, each process of a container would compile anew.
RUN export STILLPATH_DATA_DIR=/dist/data PATH=/opt/stillpath/bin:$PATH \
    && stillpath machines set-firmware ender3 firmware/marlin.json --as marlin \
    && stillpath machines set-firmware ender3 firmware/reprapfirmware.json --as reprapfirmware \
    && for machine in ender3 marlin reprapfirmware; do \
        stillpath compensate warm.gcode -o /dist/warm.gcode --machine $machine \
            --report /dist/warm || exit 1; \
    done

FROM python:${PYTHON}-slim
LABEL org.opencontainers.image.title="Stillpath" \
      org.opencontainers.image.licenses="Apache-2.0"
RUN useradd --system --uid 10001 --no-create-home --home-dir /data stillpath \
    && install -d -o 10001 -g 10001 /data
# Root's, and never written: the image runs with a read-only root.
COPY --from=build /opt/stillpath /opt/stillpath
ENV PATH=/opt/stillpath/bin:$PATH \
    NUMBA_CPU_NAME=generic \
    NUMBA_CACHE_DIR=/opt/stillpath/numba \
    OPENBLAS_NUM_THREADS=1 \
    OMP_NUM_THREADS=1 \
    PYTHONSAFEPATH=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    XDG_CACHE_HOME=/data/cache \
    STILLPATH_DATA_DIR=/data
USER 10001:10001
WORKDIR /data
VOLUME /data
EXPOSE 8000
# Running jobs go back to the queue.
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=30s --timeout=5s --start-period=30s \
    CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8000/readyz', timeout=4)"]
# Other computers can reach this address, so callers must show a key. The first one is in the file
# /data/first-key, or is what STILLPATH_FIRST_KEY says.
CMD ["stillpath", "serve", "--host", "0.0.0.0", "--port", "8000"]
