# docker build -t fewview .
# A torch without CUDA is a tenth of the size: pass the index that has it as TORCH_INDEX_URL.
FROM python:3.12-slim AS build
ARG TORCH_INDEX_URL=
RUN python -m venv /opt/fewview
ENV PATH=/opt/fewview/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY client client
COPY fewview_server fewview_server
COPY models models
COPY store store
COPY worker worker
COPY service service
RUN if [ -n "$TORCH_INDEX_URL" ]; then pip install --index-url "$TORCH_INDEX_URL" torch==2.13.0; fi \
    && pip install ./client .

FROM python:3.12-slim
RUN useradd --create-home --uid 1000 fewview && install -d -o fewview -g fewview /data
COPY --from=build /opt/fewview /opt/fewview
ENV PATH=/opt/fewview/bin:$PATH FEWVIEW_DATA_DIR=/data FEWVIEW_HOST=0.0.0.0 FEWVIEW_OPEN_TO_NETWORK=true \
    PYTHONUNBUFFERED=1
USER fewview
WORKDIR /data
RUN fewview precompile
VOLUME /data
EXPOSE 8000
HEALTHCHECK --interval=5s --timeout=5s --start-period=30s --retries=6 \
    CMD ["python", "-P", "-c", "import urllib.request as u; u.urlopen('http://127.0.0.1:8000/health/ready', timeout=4)"]
ENTRYPOINT ["fewview"]
CMD ["serve"]
