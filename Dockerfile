# One image for `kinecast serve` and `kinecast worker`. Holds the code and the shipped base model; no recordings.
#
#   docker build --tag kinecast .
#   docker run --rm -p 127.0.0.1:8000:8000 -v kinecast:/var/lib/kinecast kinecast
#
# Where PyTorch's index cannot be reached: --build-arg TORCH_INDEX=<your package index> (PyPI's wheels are larger: with CUDA).

# not the slim one: the kernel wants a C compiler
FROM python:3.11 AS build
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG TORCH_VERSION=2.13.0
RUN python -m venv /opt/kinecast
ENV PATH=/opt/kinecast/bin:$PATH
WORKDIR /src
RUN pip install --no-cache-dir --index-url "$TORCH_INDEX" "torch==$TORCH_VERSION"
COPY .constraints.txt pyproject.toml README.md ./
COPY app app
COPY models models
COPY migrations migrations
RUN pip install --no-cache-dir --constraint .constraints.txt .

FROM python:3.11-slim
RUN groupadd --gid 10001 kinecast \
    && useradd --uid 10001 --gid kinecast --home-dir /var/lib/kinecast --no-create-home \
        --shell /usr/sbin/nologin kinecast \
    && install --directory --owner kinecast --group kinecast --mode 0700 /var/lib/kinecast
COPY --from=build /opt/kinecast /opt/kinecast
ENV PATH=/opt/kinecast/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    KINECAST_HOST=0.0.0.0 \
    KINECAST_PORT=8000 \
    KINECAST_DATA_DIR=/var/lib/kinecast
USER 10001:10001
WORKDIR /var/lib/kinecast
VOLUME /var/lib/kinecast
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s --retries=3 \
    CMD ["python", "-c", "import os, urllib.request as u; u.urlopen('http://127.0.0.1:' + os.environ['KINECAST_PORT'] + '/readyz', timeout=4)"]
# The exec form, so that the signal to stop reaches kinecast and no shell.
ENTRYPOINT ["kinecast"]
CMD ["serve"]
