"""Hydra plug-in with the path of the models' configurations; Hydra imports the namespace `hydra_plugins`."""

from importlib.resources import files

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin

from frictionzoo.core.config import CONF_DIR


class FrictionzooMakkar(SearchPathPlugin):
    """Plug-in that adds this package's `conf` to frictionzoo's search path."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the folder if the running program is frictionzoo.

        Args:
            search_path: Search path of the running program; Hydra calls every installed plug-in.
        """
        if any(element.path == str(CONF_DIR) for element in search_path.get_path()):
            search_path.append("frictionzoo-makkar", f"file://{files('frictionzoo_makkar') / 'conf'}")
