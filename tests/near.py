"""A block-face bench in this process, on simulated time: the real drivers, and twins at the other end of the wire."""

import threading
from dataclasses import dataclass, field

from killing import CHANGES, World, far_rig
from sections import BENCH, RECIPE, files

from acquire.recipe import load_recipe
from acquire.resume import interrupted_run
from acquire.session import Options, new_session, resumed_session
from devices.rig import load_rig
from sim.clock import SimClock


class Near:
    """The world without wires to another process. ``on_wire`` is called with each exchange."""

    def __init__(self, world):
        self.world, self.on_wire = world, lambda what, given: None

    def wire(self, what, *given):
        self.on_wire(what, given)
        return self.world.do(what, *given)


@dataclass
class Bench:
    """A recipe, an instrument, and the world behind it.

    ``answers`` are given to the questions of a run, in turn; ``asked`` are the questions that came.
    """

    folder: object
    bench: str = BENCH
    recipe: str = RECIPE
    told: list = field(default_factory=list)
    answers: list = field(default_factory=list)
    asked: list = field(default_factory=list)

    def __post_init__(self):
        self.folder.mkdir(exist_ok=True)
        instrument, self.recipe_file = files(self.folder, self.bench, self.recipe)
        self.spec = load_rig(instrument, CHANGES)
        self.clock = SimClock(100.0)
        self.world = World(self.spec, self.clock)
        self.near = Near(self.world)
        self.run_folder = self.folder / "run"
        self.on = {}

    @property
    def knife(self):
        return self.world.feed.plc.knife

    def rig(self):
        return far_rig(self.spec, self.clock, self.near)

    def hear(self, event):
        self.told.append(event)
        if act := self.on.get(event["event"]):
            act(event)
        if event["event"] == "state" and event["state"] == "HOLD":
            self.asked.append(self.session.status.question)
            self.session.answer(self.answers.pop(0) if self.answers else "end")

    def run(self, *, attended=True, **options):
        recipe = load_recipe(self.recipe_file)
        options = Options(attended=attended, **options)
        self.session = new_session(recipe, self.rig(), self.run_folder, self.clock, self.hear, options)
        return self.session.execute()

    def go_on(self, *, attended=True, **options):
        stored = interrupted_run(self.run_folder, None)
        self.session = resumed_session(stored, self.rig(), self.clock, self.hear, Options(attended=attended, **options))
        return self.session.execute()

    def events(self, *kinds):
        return [event for event in self.told if event["event"] in kinds]


def in_thread(do):
    """Run something in a thread and return the thread."""
    thread = threading.Thread(target=do)
    thread.start()
    return thread
