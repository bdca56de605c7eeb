"""Which packages a wheel holds: those of the project, and ``conf/``, which lies at the top of a checkout.

The rest stands in pyproject.toml, whose table of packages can't find some and name others.
"""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["hdrqn_torchrl*"]), "hdrqn_torchrl.conf"],
    package_dir={"hdrqn_torchrl.conf": "conf"},
    package_data={"hdrqn_torchrl": ["py.typed"], "hdrqn_torchrl.conf": ["**/*.yaml"]},
)
