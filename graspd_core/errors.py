"""Wrong use raises one of these; failing to find a grasp is an `Outcome`, never an exception."""


class GraspdError(Exception):
    """Base of every error graspd raises on purpose: one line that names the culprit and the valid choices."""


class MeshError(GraspdError):
    """A mesh cannot be read or holds no usable surface."""


class CloudError(GraspdError):
    """A point cloud cannot be read or shows no usable object."""


class NoObjectError(CloudError):
    """A scene was seen well enough, and what was asked for is not in it."""


class BagError(GraspdError):
    """A bag cannot be read, or lacks what was asked of it."""


class HandError(GraspdError):
    """A hand description cannot be found, read or used."""


class ConfigError(GraspdError):
    """A setting is unknown, of the wrong type or out of range."""


class FormatError(GraspdError):
    """A grasps file is not in the format or version that this reader knows."""


class TransformError(GraspdError):
    """Where one frame stands in another is not known, not at that time, or makes no sense."""


class SimulatorError(GraspdError):
    """A trial needs a simulator that is not installed, or that cannot take the scene."""
