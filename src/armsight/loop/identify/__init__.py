"""What an arm really is, from joint angles and where its tool was seen.

    measured -> place -> observable -> fit -> growth -> identify -> corrected

``identify.identify`` runs the line; ``plan`` says where to look next. Equations and formats: docs/identify.md.
"""
