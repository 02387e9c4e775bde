"""The tree of links and joints of a URDF, and which of its links end an arm.

In: the links and joints of a URDF file. Out: the joints from the base to the tool. An arm is four to seven rotary joints
in a row; joints before it (a lift, a rail) are held at zero, a gripper's behind it and others beside it (wheels, a head)
are left out; both are logged. Where a file does not say which link is the tool, the message names those that could be.
"""

from __future__ import annotations

import logging
import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from itertools import dropwhile
from pathlib import Path
from typing import NamedTuple

from armsight.data import Array
from armsight.errors import NAMED, InputError, some
from armsight.robot.kinematics.table import FEWEST_JOINTS, MOST_JOINTS

ROTARY = ("revolute", "continuous")
MOVING = (*ROTARY, "prismatic", "floating", "planar")
_FLANGE = "tool0"  # what ROS calls an arm's flange where a tool is mounted (REP 199)
#: A last joint of such a name is a gripper's.
_GRIPPERS = ("grip", "jaw", "finger", "knuckle", "thumb")
_COUNT = f"{FEWEST_JOINTS} to {MOST_JOINTS}"
_LOG = logging.getLogger(__name__)


class Joint(NamedTuple):
    """A joint element: its name, type and links, its pose (4, 4) in the parent link, m, and the element itself."""

    name: str
    kind: str
    parent: str
    child: str
    T_parent_joint: Array
    element: ET.Element

    @property
    def mimics(self) -> str | None:
        """The joint that this one follows; None where it moves by itself."""
        mimic = self.element.find("mimic")
        return None if mimic is None else mimic.get("joint", "")

    @property
    def moves(self) -> bool:
        """Whether it is no fixed one."""
        return self.kind != "fixed"

    @property
    def rotary(self) -> bool:
        """Whether it can be an arm's: it rotates, by itself."""
        return self.kind in ROTARY and self.mimics is None

    @property
    def other(self) -> bool:
        """Whether it moves, but not as an arm's joint does."""
        return self.moves and not self.rotary

    @property
    def grips(self) -> bool:
        """Whether it is a gripper's by its name."""
        return any(word in self.name.lower() for word in _GRIPPERS)


class Tree:
    """Links and joints of one file; InputError where a name repeats, or a link is missing or hangs on two or itself."""

    def __init__(self, path: str | Path, links: list[str | None], joints: list[Joint]) -> None:
        """Hold a tree."""
        self._path, self._joints = path, joints
        self._below: defaultdict[str, list[Joint]] = defaultdict(list)
        for kind, names in (("links", links), ("joints", [joint.name for joint in joints])):
            if twice := [name for name, count in Counter(names).items() if count > 1]:
                raise InputError(f"{path}: two {kind} are called {twice[0]!r}")
        above: dict[str, Joint] = {}
        for joint in joints:
            for link in (joint.parent, joint.child):
                if link not in links:
                    raise InputError(f"{path}: joint {joint.name!r}: there is no link {link!r}")
            if joint.child in above:
                both = f"{above[joint.child].name!r} and {joint.name!r}"
                raise InputError(f"{path}: link {joint.child!r} hangs on two joints, {both}")
            above[joint.child] = joint
            self._below[joint.parent].append(joint)
        self._chains = {link: self._up(link, above) for link in above}

    def chain(self, tool_link: str | None) -> list[Joint]:
        """Return the joints from the base to the tool, or to the end of the one arm; what is left out beside is logged."""
        chain = self._chains.get(tool_link or self._tool(), [])
        held = [joint for joint in chain if joint.other]
        if not _is_arm(chain):
            why = f" ({_named(held)} before it)" if held else ""
            there = ", ".join(self._tools()) or "none"
            raise InputError(
                f"{self._path}: link {tool_link!r} is not behind {_COUNT} rotary joints alone{why}; these are: {there}"
            )
        if held:
            names = ", ".join(joint.name for joint in held)
            _LOG.warning("%s: joints before the arm are held at zero: %s", self._path, names)
        if beside := ", ".join(joint.name for joint in self._joints if joint.moves and joint not in chain):
            tool = chain[-1].child
            _LOG.warning("%s: the tool is %s; joints beside the arm are left out: %s", self._path, tool, beside)
        return chain

    def _up(self, link: str, above: dict[str, Joint]) -> list[Joint]:
        found: list[Joint] = []
        while link in above:
            if above[link] in found:
                raise InputError(f"{self._path}: link {link!r} hangs on itself")
            found.append(above[link])
            link = above[link].parent
        return found[::-1]

    def _tool(self) -> str:
        """Return the link that is the tool where none is named: the end of the one arm of the tree; else InputError."""
        arms = self._arms()
        ends = [tip for arm in arms for tip in self._tips(arm)]
        links = ", or ".join(ends[:NAMED])
        if not arms:
            raise InputError(f"{self._path}: {self._why_none()}")
        if len(arms) > 1:
            raise InputError(
                f"{self._path}: holds {len(arms)} arms: give the link that is the tool, {self._path}#{links}"
            )
        last = next(joint for joint in reversed(self._chains[arms[0]]) if joint.rotary)
        if last.grips:
            before = ", or ".join(self._tips(last.parent))
            raise InputError(
                f"{self._path}: joint {last.name!r} is a gripper's by its name, not the arm's: give the link that is the "
                f"tool, {self._path}#{before}, or {links} if it is the arm's"
            )
        if within := self._interrupting(arms[0]):
            raise InputError(
                f"{self._path}: only arms of {_COUNT} rotary joints are read here; {_named(within)}: give the link that is "
                f"the tool, {self._path}#{links}"
            )
        if len(ends) == 1:
            return ends[0]
        flanges = [link for link in self._rigid(arms[0]) if link.endswith(_FLANGE)]
        if len(flanges) != 1:
            raise InputError(
                f"{self._path}: several links end the chain: give the one that is the tool, {self._path}#{links}"
            )
        others = ", ".join(link for link in ends if link not in flanges)
        _LOG.warning("%s: the tool is %s; %s#LINK names another: %s", self._path, flanges[0], self._path, others)
        return flanges[0]

    def _why_none(self) -> str:
        rotary = [joint.name for joint in self._joints if joint.rotary]
        if there := ", or ".join(self._tools()):
            return (
                f"the {len(rotary)} rotary joints do not follow one another; only serial arms are read here: give the link "
                f"that is the tool, {self._path}#{there}"
            )
        if others := [joint for joint in self._joints if joint.other]:
            return f"only arms of {_COUNT} rotary joints are read here; {_named(others[:NAMED])}"
        names = f" ({some(rotary)})" if rotary else ""
        return f"{len(rotary)} rotary joints{names}; an arm here has {_COUNT} in a row"

    def _interrupting(self, arm: str) -> list[Joint]:
        """Return the joints behind an arm's end that are no rotary ones, where rotary ones of no gripper are, too."""
        behind = self._behind({arm}) - {joint.name for joint in self._chains[arm]}
        behind -= {joint.mimics for joint in self._joints if joint.mimics}
        there = [joint for joint in self._joints if joint.name in behind]
        return [j for j in there if j.other] if any(j.rotary and not j.grips for j in there) else []

    def _behind(self, links: set[str]) -> set[str]:
        """Return the names of all joints of the chains that pass links, also of those before them."""
        passing = (chain for link, chain in self._chains.items() if links & {link, *(joint.parent for joint in chain)})
        return {joint.name for chain in passing for joint in chain}

    def _tools(self) -> list[str]:
        """Return the first of the links that end an arm, those behind most joints first."""
        ends = [link for link, chain in self._chains.items() if _is_arm(chain) and link in self._tips(link)]
        return sorted(ends, key=lambda link: -sum(joint.rotary for joint in self._chains[link]))[:NAMED]

    def _rigid(self, link: str) -> list[str]:
        """Return a link and those that fixed joints hang on it."""
        body = [link]
        for one in body:
            body += [joint.child for joint in self._below[one] if not joint.moves]
        return body

    def _tips(self, link: str) -> list[str]:
        """Return the links that end the rigid body that begins with a link."""
        return [one for one in self._rigid(link) if all(joint.moves for joint in self._below[one])]

    def _arms(self) -> list[str]:
        """Return the first link behind the last joint of every arm of the tree."""
        roots = {joint.parent for joint in self._joints} - {joint.child for joint in self._joints}
        found: list[str] = []
        todo = [(root, 0) for root in sorted(roots, reverse=True)]
        while todo:
            link, count = todo.pop()
            out = [joint for one in self._rigid(link) for joint in self._below[one] if joint.moves]
            rotary = [joint for joint in out if joint.rotary]
            if count >= FEWEST_JOINTS:
                rotary = self._onward(link, rotary)
            if not rotary and FEWEST_JOINTS <= count <= MOST_JOINTS:
                found.append(link)
            elif count:
                todo += [(rotary[0].child, count + 1)] if len(rotary) == 1 else []  # an arm that forks is none
            else:
                todo += [(j.child, int(j.rotary)) for j in reversed(out) if j.mimics is None]
        return found

    def _onward(self, link: str, rotary: list[Joint]) -> list[Joint]:
        """Return which of the rotary joints on a rigid body go on with an arm: not a hand's fingers, nor a gripper's drive.

        A drive is what a mimic joint behind the body follows.
        """
        behind = self._behind({*self._rigid(link)})
        driving = {joint.mimics for joint in self._joints if joint.mimics and joint.name in behind}
        rotary = [joint for joint in rotary if joint.name not in driving]
        return [] if len(rotary) > 1 and all(joint.grips for joint in rotary) else rotary


def _is_arm(chain: list[Joint]) -> bool:
    """Return whether a chain has an arm's rotary joints, and none that moves otherwise between or behind them."""
    moving = list(dropwhile(lambda joint: not joint.rotary and joint.mimics is None, (j for j in chain if j.moves)))
    return all(joint.rotary for joint in moving) and FEWEST_JOINTS <= len(moving) <= MOST_JOINTS


def _named(joints: list[Joint]) -> str:
    return ", ".join(f"{j.name!r} is {'a mimic' if j.kind in ROTARY else j.kind}" for j in joints)
