# docker build -t fewview .
# With CUDA, ten times the size: docker build --build-arg TORCH=cu130 -t fewview .
# Tags can be moved to other images by who publishes them. To build of those alone that you know, give
# their digests: --build-arg PYTHON=python:3.12.12-slim-trixie@sha256:..., from `docker buildx imagetools inspect`.
# They are not written here, for the project has no machine on which it could check them.
ARG NODE=node:24.19.0-trixie-slim
ARG PYTHON=python:3.12.12-slim-trixie
FROM ${NODE} AS page
WORKDIR /src/page
COPY page ./
RUN npm ci --omit=dev --ignore-scripts && node build.mjs /src/built

FROM ${PYTHON} AS build
RUN python -m venv /opt/fewview
ENV PATH=/opt/fewview/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY requirements.lock ./
RUN pip install --no-deps --require-hashes -r requirements.lock
# A folder of https://download.pytorch.org/whl: cpu, cu130, ... What torch needs besides, for
# processors, is in the lock already. Each folder and architecture has a wheel of its own, so its hash is
# an argument: of torch and of what else the folder has for it, several separated by blanks.
ARG TORCH=cpu
ARG TORCH_SHA256=
RUN echo "torch==2.13.0$(printf ' --hash=sha256:%s' $TORCH_SHA256 | sed 's/ --hash=sha256:$//')" > torch.txt \
    && pip install --index-url "https://download.pytorch.org/whl/$TORCH" -r torch.txt
COPY pyproject.toml README.md LICENSE ./
COPY client client
COPY fewview_server fewview_server
COPY models models
COPY store store
COPY worker worker
COPY service service
COPY page page
COPY --from=page /src/built service/page/built
RUN pip install --no-deps --no-build-isolation --no-index ./client . && pip check
# Machine code for any processor of this architecture, beside the package: every user may read it.
ENV NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES=
RUN fewview precompile

FROM ${PYTHON}
LABEL org.opencontainers.image.title="Fewview" org.opencontainers.image.version="0.1.0"
RUN useradd --create-home --uid 1000 fewview && install -d -m 700 -o fewview -g fewview /data
COPY --from=build /opt/fewview /opt/fewview
ENV PATH=/opt/fewview/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    NUMBA_CPU_NAME=generic \
    NUMBA_CPU_FEATURES= \
    FEWVIEW_DATA_DIR=/data \
    FEWVIEW_HOST=0.0.0.0
USER fewview
WORKDIR /data
VOLUME /data
EXPOSE 8000
HEALTHCHECK --interval=10s --timeout=8s --start-period=60s --start-interval=2s --retries=3 \
    CMD ["fewview", "health", "api"]
ENTRYPOINT ["fewview"]
CMD ["serve"]
