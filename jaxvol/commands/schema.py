"""`jaxvol schema`: the JSON schema of a scene file."""

import json

from jaxvol.scene_config import json_schema


def schema() -> None:
    """Print the JSON schema of a scene file, for editors and for programs that write scenes."""
    print(json.dumps(json_schema(), indent=2))
