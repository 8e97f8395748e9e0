"""Things of a planning scene, as `moveit_msgs/CollisionObject` tells of them: obstacles of every later request."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from moveit_msgs.msg import CollisionObject

from graspd_core import Scene, SceneConfig, TriangleMesh, with_neighbours
from graspd_core.config import load_scene_config
from graspd_core.errors import TransformError
from graspd_ros.convert import Matrix, pose_matrix
from graspd_ros.inputs.solids import bad_message, mesh_shapes, moved_mesh, primitive_shapes
from graspd_ros.request import FrameLookup, Request

MOST_THINGS = 1000


@dataclass(frozen=True, eq=False)
class Thing:
    """A thing of the planning scene.

    Attributes:
        frame: the frame of its pose.
        T_frame_thing: its pose.
        shapes: what it is made of, in its own frame [m].
    """

    frame: str
    T_frame_thing: Matrix
    shapes: tuple[TriangleMesh, ...]


def changed_things(things: Mapping[str, Thing], message: CollisionObject) -> Mapping[str, Thing]:
    """The things by id, as a message leaves them; those given stay as they are.

    Raises:
        RequestError: the message names no thing that is there, or no shape or pose that can be used.
    """
    name, owner, operation = message.id, f"collision object {message.id[:128]!r}", message.operation
    if operation == CollisionObject.REMOVE and not name:
        return {}
    if not name:
        raise bad_message(owner, "id: empty; every thing needs one, but REMOVE, which then removes all")
    if operation not in _OPERATIONS:
        raise bad_message(owner, f"operation: {operation[0]}; valid: ADD=0, REMOVE=1, APPEND=2, MOVE=3")
    there = things.get(name)
    if there is None and operation in (CollisionObject.REMOVE, CollisionObject.MOVE):
        raise bad_message(owner, f"{_OPERATIONS[operation]}: there is none; there are: {', '.join(things) or 'none'}")
    if operation == CollisionObject.REMOVE:
        return {other: thing for other, thing in things.items() if other != name}
    if there is None and len(things) >= MOST_THINGS:
        raise bad_message(owner, f"{MOST_THINGS} things are kept already; REMOVE some")
    return {**things, name: _changed(there, message, owner)}


_OPERATIONS = {
    CollisionObject.ADD: "ADD",
    CollisionObject.REMOVE: "REMOVE",
    CollisionObject.APPEND: "APPEND",
    CollisionObject.MOVE: "MOVE",
}


def _changed(there: Thing | None, message: CollisionObject, owner: str) -> Thing:
    """The thing after ADD, APPEND or MOVE."""
    if message.planes:
        raise bad_message(owner, "planes: not taken, since they have no end; give a box, or the request's surface")
    shapes = (
        *primitive_shapes(message.primitives, message.primitive_poses, owner),
        *mesh_shapes(message.meshes, message.mesh_poses, owner),
    )
    # MoveIt too has the appended shapes relative to the pose that the thing has.
    if message.operation == CollisionObject.APPEND and there is not None:
        return replace(there, shapes=(*there.shapes, *shapes))
    if not message.header.frame_id:
        raise bad_message(owner, "header.frame_id: empty; name the frame of its pose")
    frame, T = message.header.frame_id, pose_matrix(message.pose, f"{owner}: pose")
    if message.operation == CollisionObject.MOVE and there is not None:
        if shapes:
            raise bad_message(owner, "MOVE with shapes; give ADD, or no shapes")
        return Thing(frame, T, there.shapes)
    if not shapes:
        raise bad_message(owner, "no primitives and no meshes; give one of them")
    return Thing(frame, T, shapes)


def among_things(request: Request, lookup: FrameLookup) -> Request:
    """Return the request whose scene has its `things` about its object; none of its other fields changes.

    `lookup` is of two frames when the object was seen. Raises TransformError: it does not know a thing's frame.
    """
    settings, load = request.settings, request.load
    placed = {name: _placed(name, thing, request, lookup) for name, thing in request.things.items()}

    def loaded() -> Scene:
        config = load_scene_config(settings.scene_config) if settings.scene_config else SceneConfig()
        return with_neighbours(load(), placed, config)

    return replace(request, load=loaded)


def _placed(name: str, thing: Thing, request: Request, lookup: FrameLookup) -> list[TriangleMesh]:
    """Its shapes in the object's own frame."""
    try:
        T = request.to_object(thing.frame, thing.T_frame_thing, lookup)
    except TransformError as error:
        raise TransformError(f"collision object {name!r}: {error}") from None
    return [moved_mesh(shape, T) for shape in thing.shapes]
