"""The scheme of Hahn and Stursberg, whole: as printed, exact, and from a policy library."""
