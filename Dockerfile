# On a CPU: docker build -t hdrqn . && docker run --rm -v "$PWD/outputs:/app/outputs" hdrqn train env=gridworld algo=v3
FROM python:3.11-slim

WORKDIR /app
# PyTorch's own wheels for CPUs are a tenth of those with CUDA; the version is that of constraints.txt.
COPY constraints.txt ./
RUN grep -E '^torch==' constraints.txt > torch.txt \
    && pip install --no-cache-dir --index-url https://download.pytorch.org/whl/cpu -r torch.txt \
    && rm torch.txt

COPY pyproject.toml setup.py README.md LICENSE ./
COPY conf conf
COPY hdrqn_torchrl hdrqn_torchrl
COPY zoo zoo
RUN grep -vE '^(torch==|triton|nvidia-|cuda-)' constraints.txt > versions.txt \
    && pip install --no-cache-dir -c versions.txt -e '.[minigrid,video]' \
    && rm versions.txt

ENV OMP_NUM_THREADS=1
ENTRYPOINT ["hdrqn"]
CMD ["--help"]
