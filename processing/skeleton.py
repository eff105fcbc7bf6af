"""The skeleton of a mask in three dimensions, and the graph it is: nodes, ends, and the branches between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import fill_voids
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from processing.distance import to_nearest
from processing.labels import components
from processing.masks import as_mask, some_of
from processing.neighbours import CUBIC, Spacing, checked_spacing
from processing.operators import Layer, operator
from processing.table import Picture, Table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Inside = NDArray[np.bool_]

LINK, NODE, END = 85, 170, 255
MOST_ROUNDS = 40  # of pruning; each takes one branch off every node that has one to spare
NOWHERE = -1
SHOWN_PX = 500
COLOURS = {LINK: (255, 255, 255), NODE: (255, 64, 64), END: (255, 220, 0)}
BRANCH_COLUMNS = ("branch", "kind", "from", "to", "voxels", "length_um", "chord_um", "radius_um")
NODE_COLUMNS = ("node", "kind", "z_um", "y_um", "x_um", "branches", "radius_um")


@operator(
    "skeleton.graph",
    gives=[
        Layer("volume", "volume", "uint8"),
        Layer("branches"),
        Layer("nodes"),
        Layer("skeleton"),
        *(Layer(name, dtype="int64") for name in ("parts", "loops", "cavities")),
    ],
)
def graph(
    volume: Array, spacing_um: Spacing | None = None, *, prune: float = 1.0
) -> tuple[Array, Table, Table, Picture, np.int64, np.int64, np.int64]:
    """Skeleton of a mask, one voxel thin and joined as the mask is, as a graph of branches between nodes and ends.

    Thinned by scikit-image (Lee, Kashyap and Chu 1994). A voxel of the skeleton with more than two of its 26 neighbours
    in it belongs to a node, and touching ones to the same; one with a single neighbour is an end.

    Parameters
    ----------
    volume : array (z, y, x)
        A mask.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x). Thinning counts voxels, lengths are true.
    prune : float
        Branches with a free end are cut, the shortest of a node first, if shorter than this many times the distance
        from the node to the surface; 0 cuts none.

    Returns
    -------
    volume : array (z, y, x) uint8
        85 on links, 170 on nodes, 255 on ends, 0 elsewhere.
    branches : Table
        Kind (link between nodes, end, free on both sides, ring), nodes it goes from and to, voxels, length along the
        voxels (on oblique lines up to √(1 + (√2-1)² + (√3-√2)²), 13 %, too long) and straight, mean distance to the
        surface.
    nodes : Table
        Kind (node, end, point, ring), place of its middle, number of branches, distance to the surface.
    skeleton : Picture
        Seen along z: links white, nodes red, ends yellow.
    parts, loops : int
        Connected parts, and closed loops: branches - nodes + parts.
    cavities : int
        Closed cavities of the mask. The shells around them cannot be thinned to lines: each stays a surface and counts
        as one node, and loops are wrong. Fill them first where there are any: mask.fill_holes.

    Raises
    ------
    InputError
        ``mask-empty``, ``mask-full``, ``mask-needed``, ``spacing``; ``volume-shape``, ``volume-nan``.
    """
    inside = some_of(as_mask(volume), "thin")
    net, depth = net_of(inside, checked_spacing(spacing_um or CUBIC), prune)
    cavities = components(fill_voids.fill(inside) & ~inside, rule=6)[1]
    kinds = net.kinds_in(inside.shape)
    parts, loops = net.parts_and_loops()
    return (
        kinds,
        net.branch_table(),
        net.node_table(),
        Picture(drawn(kinds, depth)),
        np.int64(parts),
        np.int64(loops),
        cavities,
    )


def net_of(inside: Inside, spacing: Spacing, prune: float) -> tuple[Net, Array]:
    """Return the skeleton of a mask as a graph, short branches cut, and how far it is to the surface everywhere."""
    depth = to_nearest(inside, spacing)
    skeleton = thinned(inside)
    net = Net.of(skeleton, depth, spacing)
    for _ in range(MOST_ROUNDS):
        short = net.to_prune(prune)
        if not short.any():
            break
        skeleton[tuple(net.voxels[np.isin(net.path, np.flatnonzero(short))].T)] = False
        skeleton = thinned(skeleton)
        net = Net.of(skeleton, depth, spacing)
    return net, depth


def thinned(inside: Inside) -> Inside:
    """Thin a mask to lines of one voxel; every part of it leaves something."""
    from skimage.morphology import skeletonize  # noqa: PLC0415  takes half a second

    flat = len(inside) == 1
    thin: Inside = skeletonize(inside[0] if flat else inside).astype(np.bool_)  # type: ignore[no-untyped-call]
    thin = thin[np.newaxis] if flat else thin
    return thin | lost(inside, thin)


def lost(inside: Inside, thin: Inside) -> Inside:
    """Return a voxel of each part of a mask of which thinning left nothing: that nearest to its middle.

    scikit-image takes away both voxels of parts that are two voxels wide.
    """
    labels, count = components(inside)
    gone = np.ones(count + 1, bool)
    gone[labels[thin]] = gone[0] = False
    voxels = np.argwhere(gone[labels])
    back = np.zeros(inside.shape, bool)
    for label in np.flatnonzero(gone):
        own = voxels[labels[tuple(voxels.T)] == label]
        nearest = np.linalg.norm(own - own.mean(axis=0), axis=1).argmin()
        back[tuple(own[nearest])] = True
    return back


def groups(count: int, pairs: Array, members: Inside) -> NDArray[np.int64]:
    """Return a number for each connected group of ``members``, joined by ``pairs`` (n, 2); -1 for all others."""
    both = members[pairs].all(axis=1)
    joined = coo_array((np.ones(both.sum(), bool), tuple(pairs[both].T)), (count, count))
    label = connected_components(joined, directed=False)[1]
    numbers = np.full(count, NOWHERE, np.int64)
    numbers[members] = np.unique(label[members], return_inverse=True)[1]
    return numbers


def neighbour_pairs(voxels: Array, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return which voxels of a list in raster order are 26-neighbours, each pair once, (n, 2)."""
    strides = np.array([(shape[1] + 2) * (shape[2] + 2), shape[2] + 2, 1])
    places = (voxels + 1) @ strides
    found = []
    for step in np.ndindex(3, 3, 3):
        if step > (1, 1, 1):
            wanted = places + (np.array(step) - 1) @ strides
            at = np.minimum(np.searchsorted(places, wanted), len(places) - 1)
            here = np.flatnonzero(places[at] == wanted)
            found.append(np.stack([here, at[here]], axis=1))
    return np.concatenate(found).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Net:
    """A skeleton as a graph.

    Attributes
    ----------
    voxels : array (n, 3) int64
        Of the skeleton, in raster order.
    degree : array (n,)
        How many neighbours each has.
    path, cluster : array (n,)
        Branch or node to which each belongs; -1 for none.
    joints : array (m, 3)
        Where branches end at nodes: branch, voxel of the branch, node.
    length_um : array (branches,)
        Along the voxels, to the middles of nodes.
    centre_um : array (nodes, 3)
        Middle of each node.
    depth_um : array (n,)
        Distance of each voxel to the surface.
    """

    voxels: NDArray[np.int64]
    spacing: Spacing
    degree: NDArray[np.int64]
    path: NDArray[np.int64]
    cluster: NDArray[np.int64]
    joints: NDArray[np.int64]
    length_um: NDArray[np.float64]
    centre_um: NDArray[np.float64]
    depth_um: NDArray[np.float64]

    @classmethod
    def of(cls, skeleton: Inside, depth: Array, spacing: Spacing) -> Net:
        """Read the graph of a skeleton."""
        voxels = np.argwhere(skeleton)
        pairs = neighbour_pairs(voxels, skeleton.shape)
        degree = np.bincount(pairs.ravel(), minlength=len(voxels))
        crossing = degree > 2
        path, cluster = groups(len(voxels), pairs, ~crossing), groups(len(voxels), pairs, crossing)
        place_um = voxels * np.array(spacing)
        count = max(cluster.max(), NOWHERE) + 1
        sizes = np.maximum(np.bincount(cluster[crossing], minlength=count), 1)
        centre = np.stack([np.bincount(cluster[crossing], p[crossing], count) / sizes for p in place_um.T], axis=1)
        ordered = np.where(crossing[pairs[:, :1]], pairs[:, ::-1], pairs)
        mixed = ordered[crossing[pairs].sum(axis=1) == 1]
        joints = np.unique(np.stack([path[mixed[:, 0]], mixed[:, 0], cluster[mixed[:, 1]]], axis=1), axis=0)
        along = pairs[~crossing[pairs].any(axis=1)]
        length = np.zeros(max(path.max(), NOWHERE) + 1)
        np.add.at(length, path[along[:, 0]], np.linalg.norm(place_um[along[:, 0]] - place_um[along[:, 1]], axis=1))
        np.add.at(length, joints[:, 0], np.linalg.norm(place_um[joints[:, 1]] - centre[joints[:, 2]], axis=1))
        reach = depth[tuple(voxels.T)].astype(np.float64)
        return cls(voxels, spacing, degree, path, cluster, joints, length, centre, reach)

    @property
    def arms(self) -> NDArray[np.int64]:
        """How many nodes each branch ends at, 0 to 2."""
        return np.bincount(self.joints[:, 0], minlength=len(self.length_um))

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Voxels of each branch."""
        return np.bincount(self.path[self.path >= 0], minlength=len(self.length_um))

    def tips(self) -> list[NDArray[np.int64]]:
        """Return the voxels at which each branch ends freely: none, one or two."""
        order = np.argsort(self.path, kind="stable")
        bounds = np.searchsorted(self.path[order], np.arange(len(self.length_um) + 1))
        found = []
        for branch, arms in enumerate(self.arms):
            own = order[bounds[branch] : bounds[branch + 1]]
            free = own[self.degree[own] <= 1]
            if arms == 1 and not free.size:  # a single voxel in the corner of a node
                free = own[:1]
            found.append(free)
        return found

    def to_prune(self, prune: float) -> Inside:
        """Tell which branches are to be cut now: of each node the shortest with a free end, if it is short enough."""
        single = self.joints[(self.arms == 1)[self.joints[:, 0]]]
        order = single[np.argsort(self.length_um[single[:, 0]], kind="stable")]
        shortest = order[np.unique(order[:, 2], return_index=True)[1]]
        limit = prune * self.node_depth_um()[shortest[:, 2]]
        cut = np.zeros(len(self.length_um), bool)
        cut[shortest[self.length_um[shortest[:, 0]] < limit, 0]] = True
        return cut

    def node_depth_um(self) -> NDArray[np.float64]:
        """Return how far it is from each node to the surface."""
        depth = np.zeros(len(self.centre_um))
        there = self.cluster >= 0
        np.maximum.at(depth, self.cluster[there], self.depth_um[there])
        return depth

    def kinds(self) -> NDArray[np.uint8]:
        """Return what each voxel is: part of a link or of a node, or an end."""
        kinds = np.where(self.cluster >= 0, NODE, LINK).astype(np.uint8)
        for free in self.tips():
            kinds[free] = END
        return kinds

    def kinds_in(self, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """Return the same as a volume, 0 where no skeleton is."""
        kinds = np.zeros(shape, np.uint8)
        kinds[tuple(self.voxels.T)] = self.kinds()
        return kinds

    def rings(self) -> NDArray[np.int64]:
        """Return the branches that are closed in themselves."""
        tips = np.array([free.size for free in self.tips()], np.int64)
        return np.flatnonzero((self.arms == 0) & (tips == 0))

    def nodes(self) -> list[tuple[str, NDArray[np.float64], int, float]]:
        """Return kind, place, branches and depth of each node: crossings, then free ends and points, then rings."""
        spokes = np.bincount(self.joints[:, 2], minlength=len(self.centre_um))
        depth = self.node_depth_um()
        nodes = [("node", c, int(n), float(d)) for c, n, d in zip(self.centre_um, spokes, depth, strict=True)]
        place_um = self.voxels * np.array(self.spacing)
        for free, size in zip(self.tips(), self.sizes, strict=True):
            point = free.size == 1 == size and not self.degree[free].any()
            kind, spoke = ("point", 0) if point else ("end", 1)
            nodes += [(kind, place_um[voxel], spoke, float(self.depth_um[voxel])) for voxel in free]
        for ring in self.rings():
            voxel = int(np.flatnonzero(self.path == ring)[0])
            nodes.append(("ring", place_um[voxel], 2, float(self.depth_um[voxel])))
        return nodes

    def node_voxels(self) -> NDArray[np.int64]:
        """Return the place of a voxel of each node, (n, 3), in the order of `nodes`."""
        crossing = np.flatnonzero(self.cluster >= 0)
        first = crossing[np.unique(self.cluster[crossing], return_index=True)[1]]
        free = [voxels for voxels in self.tips() if voxels.size]
        rings = [np.flatnonzero(self.path == ring)[:1] for ring in self.rings()]
        return np.asarray(self.voxels[np.concatenate([first, *free, *rings])])

    def branches(self) -> list[tuple[str, int, int, int]]:
        """Return kind, nodes and number of each branch; single voxels are points and none."""
        rows, next_node = [], len(self.centre_um)
        rings = set(self.rings().tolist())
        ring_node = len(self.nodes()) - len(rings)
        ends = {int(b): self.joints[self.joints[:, 0] == b, 2].tolist() for b in np.unique(self.joints[:, 0])}
        for branch, (free, size) in enumerate(zip(self.tips(), self.sizes, strict=True)):
            at = ends.get(branch, [])
            if branch in rings:
                rows.append(("ring", ring_node, ring_node, branch))
                ring_node += 1
                continue
            at = [*at, *range(next_node, next_node + free.size)]
            next_node += free.size
            if size == 1 and not ends.get(branch):
                continue
            rows.append((("free", "end", "link")[len(ends.get(branch, []))], at[0], at[-1], branch))
        return rows

    def parts_and_loops(self) -> tuple[int, int]:
        """Return the number of connected parts, and that of loops, by Euler's formula."""
        nodes, rows = len(self.nodes()), self.branches()
        joined = coo_array((np.ones(len(rows), bool), ([r[1] for r in rows], [r[2] for r in rows])), (nodes, nodes))
        parts = int(connected_components(joined, directed=False)[0])
        return parts, len(rows) - nodes + parts

    def branch_table(self) -> Table:
        """Return all branches."""
        nodes = self.nodes()
        depth = np.bincount(self.path[self.path >= 0], self.depth_um[self.path >= 0], len(self.length_um))
        rows = []
        for number, (kind, one, other, branch) in enumerate(self.branches()):
            size, length = int(self.sizes[branch]), float(self.length_um[branch])
            chord = float(np.linalg.norm(nodes[one][1] - nodes[other][1]))
            rows.append((number, kind, one, other, size, length, chord, float(depth[branch] / size)))
        return Table(BRANCH_COLUMNS, tuple(rows))

    def node_table(self) -> Table:
        """Return all nodes."""
        rows = [
            (k, kind, *(float(p) for p in place), spokes, depth)
            for k, (kind, place, spokes, depth) in enumerate(self.nodes())
        ]
        return Table(NODE_COLUMNS, tuple(rows))


def drawn(kinds: NDArray[np.uint8], depth: Array) -> NDArray[np.uint8]:
    """Draw a skeleton as seen along z, the mask grey behind it."""
    ground = depth.max(axis=0)
    grey = np.asarray(ground * (110 / max(float(ground.max()), 1e-9)), np.uint8)
    enlarged = max(1, round(SHOWN_PX / max(grey.shape)))
    picture = np.repeat(grey[..., np.newaxis], 3, axis=2)
    for kind in (LINK, END, NODE):
        picture[(kinds == kind).any(axis=0)] = COLOURS[kind]
    size = (picture.shape[1] * enlarged, picture.shape[0] * enlarged)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST), np.uint8)
