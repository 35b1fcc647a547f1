"""The page: what is shown in space, and the panel beside it."""

import threading
from collections.abc import Callable

import viser

from gnnjax.viewer.answers import Query
from gnnjax.viewer.downloads import SaveControls
from gnnjax.viewer.ends import EndControls
from gnnjax.viewer.frames import Frames
from gnnjax.viewer.obstacles import ObstacleControls
from gnnjax.viewer.player import Player
from gnnjax.viewer.prices import PricedRoadmap
from gnnjax.viewer.session import ENDS, Session
from gnnjax.viewer.stage import Stage

_PRICE_PAUSE_S = 0.3  # after the last edit
_FIRST = "compiling (the first run takes up to a minute, later ones seconds) and planning ..."
_WAITING = "planning ... the last path stays, grey; the arm comes back with the next one"


class Panel:
    """Follows a session in all browsers that are connected, and edits it."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        frames: Frames,
        query_text: Callable[[], str],
        price: Callable[[Query], PricedRoadmap] | None,
        why_no_price: str = "",
    ):
        """Args:
        server: of the browsers.
        session: what is edited.
        frames: of its arm.
        query_text: makes the text of the query, to be saved.
        price: makes what is shown of a roadmap, where the planner has one beforehand.
        why_no_price: why it has none.
        """
        self.session, self._price = session, price
        self._lock = threading.RLock()
        self._priced_for: Query | None = None
        gui = server.gui
        # The button would open the page to all the world.
        gui.configure_theme(show_share_button=False)
        server.scene.add_grid("/floor", 3.0, 3.0, cell_size=0.1, section_size=0.5)
        self.stage = Stage(
            server, session.robot, frames, lambda number: self.obstacles.choose(number)
        )
        self.stage.show_cloud(session)
        self.status = gui.add_markdown("")
        with gui.add_folder("Motion"):
            self.player = Player(server, self.stage)
        tabs = gui.add_tab_group()
        self.ends = {}
        for end in ENDS:
            with tabs.add_tab(end.capitalize()):
                ghost = self.stage.ghosts[end]
                self.ends[end] = EndControls(server, session, end, ghost, frames)
        with tabs.add_tab("Obstacles"):
            self.obstacles = ObstacleControls(server, session, self._lock, self.show)
        with tabs.add_tab("View"):
            self._add_view(gui, why_no_price)
        with tabs.add_tab("Save"):
            self.saving = SaveControls(server, session, query_text)
        session.changed = self.show
        self.show()

    def show(self) -> None:
        """Follows the session; any thread may call it."""
        session = self.session
        with self._lock:
            self.obstacles.show()
            self.stage.show_obstacles(session, self.obstacles.number)
            for end in self.ends.values():
                end.show()
            answer, current = session.answer, session.is_current
            self.stage.show_path(answer, current)
            self.player.show(answer if current else None)
            lines = [_FIRST if answer is None else answer.text if current else _WAITING]
            if session.message:
                lines.insert(0, f"**{session.message}**")
            self.status.content = "\n\n".join(lines)
            self._ask_for_prices()

    def close(self) -> None:
        """Ends what moves by itself."""
        self.session.changed = lambda: None
        self.player.close()
        self.session.worker.close()

    def _add_view(self, gui: viser.GuiApi, why_no_price: str) -> None:
        shown = {name: gui.add_checkbox(name, True) for name in ("ghosts", "handles", "path")}
        self.axes = gui.add_checkbox("frames of the arm", False)
        self.prices = gui.add_checkbox(
            "roadmap",
            False,
            disabled=self._price is None,
            hint=why_no_price or "its edges, from red (surely blocked) to green (surely free)",
        )
        self.least = gui.add_slider(
            "edges that are free at least by", 0.0, 1.0, 0.01, 0.05, disabled=self._price is None
        )

        @shown["ghosts"].on_update
        async def _(event):
            for ghost in self.stage.ghosts.values():
                ghost.root.visible = event.target.value

        @shown["handles"].on_update
        async def _(event):
            for end in self.ends.values():
                end.handles.visible = event.target.value

        @shown["path"].on_update
        async def _(event):
            self.stage.paths.visible = event.target.value

        @self.axes.on_update
        async def _(event):
            self.stage.arm.show_axes(self.axes.value)

        async def price(event):
            self._priced_for = None
            self.show()

        self.prices.on_update(price)
        self.least.on_update(price)

    def _ask_for_prices(self) -> None:
        query = self.session.query
        if self._price is None or query is self._priced_for:
            return
        self._priced_for = query
        self.stage.show_prices(None)
        if self.prices.value:
            self.session.worker.ask("prices", self._show_prices, _PRICE_PAUSE_S)

    def _show_prices(self) -> None:
        query = self.session.query
        assert self._price is not None
        priced = self._price(query)
        with self._lock:
            if self.prices.value and query is self.session.query:
                self.stage.show_prices(priced, self.least.value)
