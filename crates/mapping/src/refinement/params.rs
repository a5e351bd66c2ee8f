//! The parameters of the refinement.

/// How far an adjustment may go.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefinementParams {
    /// First rounds of the adjustment, in which cameras stand still, so that what does not fit loses its weight before any
    /// camera can move to please it.
    pub fixed_rounds: usize,
    /// What the ground may be displaced by a camera in these rounds, one standard deviation, metres.
    pub fixed_pose_m: f64,
    /// How far the spread of the cameras' corrections may exceed their measured quality, as a factor: the measurement itself is
    /// right to about a half.
    pub most_pose_factor: f64,
    /// Standard deviation of what the boxes of one view on one bench have in common besides an offset, pixels.
    pub shared_px: f64,
    /// Most times that what does not fit is matched anew and all is adjusted again.
    pub most_verifications: usize,
    /// How far from a module a sighting may lie that shows it, as a share of the pitch.
    pub most_rest_pitches: f64,
    /// Sightings of one view on one bench that must agree on another place to be moved there.
    pub least_moved: usize,
    /// Share of the boxes of a piece that no bench took which must lie on modules of one bench to be given to it.
    pub adopted_share: f64,
    /// How near, as a share of a module's shorter side, the middles of modules of two benches may come: two thirds of it, so
    /// that at most a third of a module is shared.
    pub most_shared: f64,
    /// How far about a bench others tell how high it stands, metres: the distance of two or three lines.
    pub neighbour_reach_m: f64,
    /// Fewest and most of them.
    pub least_neighbours: usize,
    pub most_neighbours: usize,
    /// How much lower than a bench between its neighbours what lies on the ground is at least, metres: tables begin at half a
    /// metre and more above the ground, and rise from there.
    pub least_low_m: f64,
    /// How much heights of neighbouring benches scatter about a plane, metres, and slopes of the ground, as a share.
    pub height_scatter_m: f64,
    pub slope_sigma: f64,
    /// Standard deviation of the edge of a box in units of that of its centre.
    pub edge_spread: f64,
    /// How well the cloud is taken to know the place of a bench before anything is known of it, and at best, metres: where
    /// views and cloud disagree the views are right.
    pub first_cloud_m: f64,
    pub best_cloud_m: f64,
    /// How far from a right angle a table may be, as the cosine.
    pub square_sigma: f64,
    /// How far a bench bends from straight over half its length, metres.
    pub bend_sigma_m: f64,
    /// How much the ground that one view shows may be displaced before anything is known of it, metres.
    pub first_pose_m: f64,
    /// Most rounds of the adjustment.
    pub most_rounds: usize,
    /// Rounds end when nothing moves further than this any more, metres, and spreads change by no more than this share.
    pub settled_m: f64,
    pub settled: f64,
    /// Residuals looked at to measure how well boxes are centred, at most.
    pub most_sampled: usize,
    /// Modules that two views must have in common to be compared before the adjustment.
    pub least_common: usize,
    /// Relative difference of their pitches up to which benches are of one type.
    pub type_alike: f64,
    /// How much the pitch of one bench deviates from that of its type, as a share: half a millimetre in a metre.
    pub type_sigma: f64,
    /// Most views whose correlations are taken into a stated deviation, and up to how many views the variance of their
    /// corrections is taken exactly: the cost grows with the cube.
    pub window_views: usize,
    pub exact_views: usize,
    /// Views of a bench from which its places by either half of them are compared.
    pub least_halved: usize,
    /// Weight of the expected scatter against the measured one, in compared benches.
    pub scatter_prior: f64,
    /// What boxes have in common in all views, as a share of what differs from view to view.
    pub common_share: f64,
}

impl Default for RefinementParams {
    fn default() -> Self {
        Self {
            fixed_rounds: 3,
            fixed_pose_m: 0.005,
            most_pose_factor: 1.5,
            shared_px: 0.3,
            most_verifications: 4,
            most_rest_pitches: 0.3,
            least_moved: 3,
            adopted_share: 0.9,
            most_shared: 0.67,
            neighbour_reach_m: 30.0,
            least_neighbours: 3,
            most_neighbours: 8,
            least_low_m: 0.7,
            height_scatter_m: 0.3,
            slope_sigma: 0.15,
            edge_spread: 3.0,
            first_cloud_m: 2.0,
            best_cloud_m: 0.2,
            square_sigma: 0.003,
            bend_sigma_m: 0.1,
            first_pose_m: 0.3,
            most_rounds: 12,
            settled_m: 5e-4,
            settled: 0.05,
            most_sampled: 200_000,
            least_common: 3,
            type_alike: 0.015,
            type_sigma: 5e-4,
            window_views: 20,
            exact_views: 60,
            least_halved: 4,
            scatter_prior: 4.0,
            common_share: 0.15,
        }
    }
}
