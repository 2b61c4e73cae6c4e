"""The scheme of Hahn and Stursberg, whole: as printed, exact, and by a frozen policy where that is exact too."""
