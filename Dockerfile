# sylpose in a container, docs/install.md:
#   docker build --tag sylpose .
#   docker run --rm --read-only --tmpfs /tmp --user "$(id -u):$(id -g)" --volume "$PWD:/data" sylpose track recording
ARG PYTHON=3.13
FROM python:${PYTHON}-slim

# Code for any processor of the kind: what is compiled below is loaded wherever the image runs.
ENV NUMBA_CPU_NAME=generic \
    MPLCONFIGDIR=/tmp/matplotlib \
    PYTHONDONTWRITEBYTECODE=1

WORKDIR /build
COPY pyproject.toml README.md LICENSE ./
COPY src src
# Which of the extras in docs/install.md are wanted.
ARG EXTRAS=archive,export,matlab,network,shape,usd,viewer
RUN python -m pip install --no-cache-dir ".[${EXTRAS}]" \
    && rm -rf /build

# Beside the sources, where everybody reads it and nobody but root writes.
WORKDIR /data
RUN sylpose doctor --compile

# Whoever it is; `--user` says otherwise, for files that are to belong to somebody.
USER 1000:1000
ENTRYPOINT ["sylpose"]
CMD ["--help"]
