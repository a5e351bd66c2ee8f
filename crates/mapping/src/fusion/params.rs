//! The parameters of the fusion.

/// How geometry decides which modules are the same. Values are measured on the twins of the paper's plants and on
/// simulated flights unless another source is given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FusionParams {
    /// Standard deviation of the centre of a box, pixels, before it is measured.
    pub box_sigma_px: f64,
    /// Least standard deviation of what all boxes of a piece have in common, pixels (detectors see the edge of a table
    /// otherwise than a seam).
    pub shared_sigma_px: f64,
    /// How well a piece's depth is known by cloud or ground before its pitch tells, metres: sparse points lie on the ground,
    /// one to two metres below the tables.
    pub depth_sigma_m: f64,
    /// Slope of a row against the cloud's surface, radians: terrain.
    pub slope_sigma: f64,
    /// How far a bench bends from straight over half its length, metres.
    pub bend_sigma_m: f64,
    /// How far from a right angle a table may be, as the cosine.
    pub square_sigma: f64,
    /// Boxes that a piece needs to take part in measuring the pitch.
    pub pitch_least_boxes: usize,
    /// Least angle between the rays of two views that measure it, radians.
    pub pitch_least_angle_rad: f64,
    /// Most pairs of pieces that are triangulated for it.
    pub pitch_most_pairs: usize,
    /// How far shifts are tried about the positions by the cloud, metres.
    pub pitch_reach_m: f64,
    /// Most mean squared residual of a triangulated pair, in variances of a box.
    pub pitch_most_residual: f64,
    /// Relative width in which pitches count as equal.
    pub pitch_window: f64,
    /// Relative standard deviation of a pitch by the cloud's depth alone.
    pub pitch_rough_sigma: f64,
    /// Least number and share of the pairs that make a type of bench.
    pub pitch_least_pairs: usize,
    pub pitch_least_share: f64,
    /// Share of the pairs left that must agree; by mere chance 5 to 16 % do.
    pub pitch_agreeing_share: f64,
    /// Least relative standard deviation of a pitch.
    pub pitch_least_sigma: f64,
    /// Least standard deviation of the rise of a table across its rows, as the sine of its tilt.
    pub rise_least_sigma: f64,
    /// Most types of bench.
    pub most_types: usize,
    /// Degrees of freedom of the disagreement of two lattices (Student's t): boxes may err together in ways not foreseen.
    pub disagreement_dof: f64,
    /// Cameras are good where they disagree by no more than this share of a pitch: then one pair of pieces decides by itself
    /// (integer ambiguities are fixed at 0.15 cycles, Teunissen 1998).
    pub good_camera_pitches: f64,
    /// Least standard deviation of the disagreement of two cameras on the ground, metres.
    pub camera_least_m: f64,
    /// Share of the bench ends that a view sees wrongly (boxes missed in clusters): no end weighs more than its logarithm.
    pub false_end_share: f64,
    /// Costs of the association are negative log-likelihoods. One bench end that one view sees and the other contradicts: the
    /// logarithm of some 1.8 % of the ends, chosen on the paper's plants as simulated.
    pub end_cost: f64,
    /// Each further column by which it is contradicted, up to four: fewer modules are missed in a row than one.
    pub end_column_cost: f64,
    /// A place that is a module in one view and a hole in the other.
    pub hole_cost: f64,
    /// Most that it costs two pieces to share no module at all.
    pub beside_cost: f64,
    /// Pieces that show the same ground being different benches after all: as much as two contradicted ends and two more.
    pub different_cost: f64,
    /// A shift that positions do not allow.
    pub far_cost: f64,
    /// Two pieces of one image, with a gap or an aisle between them, in one bench.
    pub gap_cost: f64,
    /// Margin between the best and the second best shift above which a pair is beyond doubt, and above which it counts at
    /// all: odds of 150 and 12 to 1.
    pub sure_margin: f64,
    pub likely_margin: f64,
    /// Least cost that moving a piece to another place must save.
    pub least_gain: f64,
    /// Share of the greatest displacement that is looked for, above which shifts are looked for about the one that is known.
    pub displaced_share: f64,
    /// Degrees of freedom of the positions' errors: few, for local errors of structure from motion have long tails.
    pub position_dof: f64,
    /// How much more the height of a bench may disagree than its place, two views' errors being what they are, as a factor.
    pub height_factor: f64,
    /// Standard deviation of the disagreement of two views where nothing is known of the cameras, metres: views of the paper's
    /// models disagree by up to 0.6 m.
    pub view_sigma_m: f64,
    /// Least one that is learned, metres.
    pub view_least_sigma_m: f64,
    /// Within about this distance disagreements are alike, metres.
    pub view_alike_m: f64,
    /// Least pairs of pieces by which two views are compared.
    pub camera_least_pairs: usize,
    /// Weight of the plant's typical camera in the estimate of one, in pairs of views.
    pub camera_prior_pairs: f64,
    /// Relative difference of its pitch, as the cloud has it, up to which a piece may be of a type.
    pub type_most_off: f64,
    /// Rounds of the robust fit of one piece.
    pub fit_rounds: usize,
    /// Pieces looked at to measure how well boxes are centred, at most.
    pub most_sampled_pieces: usize,
    /// More than usual between two rows, in parts of the shorter pitch: an aisle.
    pub aisle: f64,
    /// Fewest columns by which an aisle is known.
    pub aisle_least_columns: usize,
    /// Farther off a lattice is too little known to see a gap by it, columns.
    pub gap_reach: f64,
    /// Steps over which the pitch at a side is measured.
    pub pitch_span: i32,
    /// What one view alone saw is left out where this many others look at the place and see the bench without it.
    pub many_views: usize,
    /// How far apart the ends of two benches of one line may stand (a road lies between them), metres.
    pub line_gap_m: f64,
    /// How far the axes of two benches of one line may be turned against each other, degrees.
    pub line_bend_deg: f64,
    /// Benches of one line face each other by their ends: how far aside of each other their middles may stand, as a share of
    /// half their widths together, and up to where it is doubtful.
    pub line_aside: f64,
    pub line_doubtful_aside: f64,
    /// Most empty columns between two benches that may be one, and how far off the lattice of the one the other may stand,
    /// columns and rows.
    pub hole_most_columns: f64,
    pub hole_off_lattice: f64,
}

impl Default for FusionParams {
    fn default() -> Self {
        Self {
            box_sigma_px: 1.0,
            shared_sigma_px: 0.3,
            depth_sigma_m: 3.0,
            slope_sigma: 0.05,
            bend_sigma_m: 0.1,
            square_sigma: 0.003,
            pitch_least_boxes: 8,
            pitch_least_angle_rad: 0.1,
            pitch_most_pairs: 3000,
            pitch_reach_m: 2.5,
            pitch_most_residual: 25.0,
            pitch_window: 0.002,
            pitch_rough_sigma: 0.04,
            pitch_least_pairs: 6,
            pitch_least_share: 0.1,
            pitch_agreeing_share: 0.25,
            pitch_least_sigma: 0.0015,
            rise_least_sigma: 0.03,
            most_types: 8,
            disagreement_dof: 8.0,
            good_camera_pitches: 0.15,
            camera_least_m: 0.02,
            false_end_share: 0.03,
            end_cost: 4.0,
            end_column_cost: 1.0,
            hole_cost: 1.0,
            beside_cost: 0.5,
            different_cost: 10.0,
            far_cost: 12.0,
            gap_cost: 12.0,
            sure_margin: 5.0,
            likely_margin: 2.5,
            least_gain: 0.5,
            displaced_share: 0.25,
            position_dof: 4.0,
            height_factor: 2.0,
            view_sigma_m: 0.35,
            view_least_sigma_m: 0.05,
            view_alike_m: 15.0,
            camera_least_pairs: 3,
            camera_prior_pairs: 2.0,
            type_most_off: 0.15,
            fit_rounds: 4,
            most_sampled_pieces: 4000,
            aisle: 0.1,
            aisle_least_columns: 6,
            gap_reach: 3.0,
            pitch_span: 4,
            many_views: 3,
            line_gap_m: 15.0,
            line_bend_deg: 12.0,
            line_aside: 0.85,
            line_doubtful_aside: 1.05,
            hole_most_columns: 4.0,
            hole_off_lattice: 0.06,
        }
    }
}
