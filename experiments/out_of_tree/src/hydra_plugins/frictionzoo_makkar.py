"""Where Hydra finds the law's configuration; Hydra imports what lies in the namespace `hydra_plugins`."""

from importlib.resources import files

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin

from frictionzoo.core.config import CONF_DIR


class FrictionzooMakkar(SearchPathPlugin):
    """Adds this package's `conf` to the search path of frictionzoo."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the folder, unless another program searches.

        Args:
            search_path: Of the program that runs; Hydra asks every plug-in of the environment.
        """
        if any(element.path == str(CONF_DIR) for element in search_path.get_path()):
            search_path.append("frictionzoo-makkar", f"file://{files('frictionzoo_makkar') / 'conf'}")
