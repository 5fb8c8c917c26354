"""Pictures of what filters, tuners and Monte-Carlo runs return: one call each, matplotlib's Axes in and out.

    out = jf.filter(filt, ys, mask=mask)
    ax = jf.plots.track(out, truth=truth, measurements=ys, mask=mask)
    ax.figure.savefig("track.png")

Every function draws into ``ax``, by default into a new figure, and returns it. Called again with the same ``ax`` it
adds its lines in the next color: filters side by side. Needs the extra ``plot``; nothing global is changed.
"""

from jaxfilt.plots.courses import errors as errors
from jaxfilt.plots.courses import estimate as estimate
from jaxfilt.plots.statistics import consistency as consistency
from jaxfilt.plots.statistics import mode_probabilities as mode_probabilities
from jaxfilt.plots.statistics import monte_carlo as monte_carlo
from jaxfilt.plots.tracks import track as track
from jaxfilt.plots.tuned import memberships as memberships
from jaxfilt.plots.tuned import pareto as pareto
from jaxfilt.plots.tuned import tuning as tuning
