"""The packages of a wheel: those of the project, and ``conf/``, which lies at the top of a checkout.

The rest is in pyproject.toml, whose table of packages can't both find some and name others.
"""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["hdrqn_torchrl*"]), "hdrqn_torchrl.conf"],
    package_dir={"hdrqn_torchrl.conf": "conf"},
    package_data={"hdrqn_torchrl": ["py.typed"], "hdrqn_torchrl.conf": ["**/*.yaml"]},
)
