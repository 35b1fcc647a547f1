"""What a browser downloads: scenes, queries and pictures.

Nothing is written where the viewer runs, which may be open to a network.
"""

from collections.abc import Callable

import imageio.v3
import numpy as np
import viser

from gnnjax.errors import InputError
from gnnjax.viewer.saving import SCENE_FILE, scene_text
from gnnjax.viewer.session import Session

_WAIT_S = 20.0  # for a picture


def picture(client: viser.ClientHandle) -> bytes:
    """A PNG of what a browser shows.

    Raises:
        InputError: the browser has gone, or does not draw.
    """
    try:
        size = client.camera.image_height, client.camera.image_width
        pixels = client.get_render(*size, transport_format="png", timeout=_WAIT_S)
    except (RuntimeError, TimeoutError) as error:
        raise InputError(f"no picture: {error}; open the page again") from None
    opaque = pixels[..., 3:] / 255
    flat = (pixels[..., :3] * opaque + 255 * (1 - opaque)).round().astype(np.uint8)
    return imageio.v3.imwrite("<bytes>", flat, extension=".png")


class SaveControls:
    """Buttons; made inside of the part of the panel that they belong to."""

    def __init__(self, server: viser.ViserServer, session: Session, query_text: Callable[[], str]):
        """Args:
        server: of the browsers.
        session: what is saved.
        query_text: makes the text of the query.
        """
        self._session = session
        self._add(server, SCENE_FILE, "scene", lambda _: scene_text(session.query.scene).encode())
        self._add(server, "query.txt", "query", lambda _: query_text().encode())
        self._add(server, "view.png", "picture", picture)

    def _add(
        self,
        server: viser.ViserServer,
        file: str,
        what: str,
        make: Callable[[viser.ClientHandle], bytes],
    ) -> None:
        # Called in a thread, as a picture takes its time.
        @server.gui.add_button(f"save {what} ({file})").on_click
        def _(event):
            if event.client is None:
                return
            try:
                event.client.send_file_download(file, make(event.client), save_immediately=True)
            except InputError as error:
                self._session.tell(str(error))
