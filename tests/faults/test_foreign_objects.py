"""Files of a run folder never construct objects: no YAML tag and no pickle is executed."""

import pickle

import pytest

from jaxswarm import config as configs
from jaxswarm.config import ConfigError

TAGS = ["!!python/object/apply:os.system ['touch {}']", "!!python/name:os.system", "!!python/object/new:list [[1]]"]


class Touch:
    """Create a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.parametrize("tag", TAGS)
def test_yaml_tags_are_refused(tag, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(f"seed: {tag.format(tmp_path / 'touched')}\n")
    with pytest.raises(ConfigError):
        configs.load(path)
    assert not (tmp_path / "touched").exists()


def test_pickles_are_not_loaded(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_bytes(pickle.dumps(Touch(tmp_path / "touched"), protocol=0))
    with pytest.raises(ConfigError):
        configs.load(path)
    assert not (tmp_path / "touched").exists()
