// Arguments of the kernels. `source.py` reads these declarations and builds the same structures with ctypes: one
// declaration a line, pointers and values of the types that it knows.
//
// Sizes: N = capacity of Gaussians (`stride`), P = capacity of pairs (`pairs`), a pair being a splat and a tile that
// it overlaps; H, W = image; groups = blocks of the backward pass. Arrays of parameters are stored by component, with
// the rows of `layout.py`. "Order" is the order of depth, nearest first.

struct RasterArguments {
    float *params, *first, *second;    // [14, N] parameters; first and second moments of Adam
    float *steps;                      // [N] Adam steps of each Gaussian
    const int *count;                  // [1] Gaussians in use
    const float *camera;               // [24] as RasterCamera.packed
    const float *rates;                // [17] learning rate of each row; weight and log ratio of the isotropy term;
                                       // learning rate of harmonics
    float *harmonics, *harmonics_first, *harmonics_second;  // [3 K, N] and moments of Adam; null = none
    float *shown;                      // [3, N] colours as the camera sees them; rows COLOUR of params without harmonics
    float *turned;                     // [3, N] dL/d(mean) through the direction to the camera; null = none
    float4 *records;                   // [N, 3] x y A B | C log2(opacity) r g | b z half_width half_height
    float *depth;                      // [N] optical z (m), the sort key; FAR for Gaussians without pairs
    int *pair_count;                   // [N] pairs of each Gaussian
    int *first_pair;                   // [N] number of its first pair
    const long long *order;            // [N] Gaussians in order
    const int *pair_end;               // [N] inclusive sums of pair_count in order
    int *most_pairs;                   // [1] largest number of pairs since it was last read, stored or not
    short *pair_tile;                  // [P] tile of each pair, in order; EMPTY_TILE behind the last one
    int *pair_gaussian;                // [P] Gaussian of each pair, in order
    const long long *sorted_pair;      // [P] pairs by tile, in order within each tile
    const int *tile_start;             // [tiles + 1] first place in sorted_pair of each tile
    const int *group_start;            // [tiles + 1] first group of each tile
    int *tile_used;                    // [tiles] pairs that the forward pass processed before all pixels had ended
    float *states;                     // [groups * 4, 5, PIXELS] T r g b depth of the pixels before each bucket
    float *image;                      // [5, H, W] red, green, blue, accumulated depth (m), alpha
    const float *gradient;             // [5, H, W] dL/d(image)
    float4 *slots;                     // [P, 3] sums of each pair: v vx vy vxx | vxy vyy wr wg | wb wz w -
    float *rows;                       // [16, N] gradients as in layout.py; null = not wanted
    float *pose_parts;                 // [N / 256, 6] sums of the pose gradient (rho, phi) of each block
    int stride, pairs, groups;
    int width, height, tiles_x, tiles;
    int learn;                         // 1 = take a step of Adam
    int harmonic_terms;                // K: 0, 3, 8 or 15
};

struct LossArguments {
    const float *image;                // [5, H, W] the render
    const unsigned char *targets;      // of the keyframe, as `pack_targets` arranges them
    const float *tone;                 // [10] exposure: gain and offset of r g b; luma weights after gain, and offset
    const float *taps;                 // [11] window of SSIM
    float *gradient;                   // [5, H, W] dL/d(image)
    float *partials;                   // [3, H, W] dSSIM/d(mean x, mean xx, mean xy)
    float *pixel_parts;                // [pixel blocks, 2] sums of |colour error| and of the depth loss
    float *beam_parts;                 // [beam blocks] sums of the loss at the beams
    float *ssim_parts;                 // [SSIM blocks] sums of SSIM
    float *exposure_parts;             // [pixel blocks, 6] sums of the exposure gradient
    int width, height;
    float colour_scale, depth_scale;   // factors of the losses, per pixel
    float lidar_weight, ssim_scale;    // weight of all beams together; dL/dSSIM of a pixel
};

struct BeginArguments {
    const double *states;              // [keyframes, KEYFRAME_STATE]
    float *camera;                     // [24] out
    float *tone;                       // [10] out
    int *keyframe;                     // [1] out: row in `states`, -1 = none
    double T_map_camera[16];           // pose as SLAM estimated it
    float intrinsics[12];              // entries 12 to 23 of RasterCamera.packed
    float exposure[6];                 // used if row is -1: log gains, offsets
    int row;
};

struct FinishArguments {
    const float *pixel_parts, *beam_parts, *ssim_parts, *exposure_parts, *pose_parts;  // see above
    double *pose_gradient;             // [6] out: (rho, phi), left perturbation of T_camera_map
    double *exposure_gradient;         // [6] out: log gains, offsets
    float *losses;                     // [loss_room] out
    int *loss_count;                   // [1] losses written so far
    double *states;                    // [keyframes, KEYFRAME_STATE]
    const int *keyframe;               // [1] row in `states`, -1 = none
    double pose_rates[2], pose_limits[2];  // of position (m) and rotation (rad)
    double exposure_rate;
    float colour_scale, ssim_weight;
    int pixel_blocks, beam_blocks, ssim_blocks, pose_blocks, pixels, loss_room;
    int with_pose, with_exposure;      // 1 = sum the gradient, and take a step if there is a keyframe
};

struct CarveArguments {
    const float *params;               // [14, N]
    int *votes;                        // [N] in out
    const unsigned char *targets;      // of the keyframe, as `pack_targets` arranges them
    float camera[24];                  // as RasterCamera.packed
    double margin;                     // relative distance to the surface
    int stride, count, width, height, least_weight;
};

struct MoveArguments {
    float *params, *first;             // [14, N] in out
    const int *columns;                // [count] Gaussians to move
    double rotation[9], translation[3];    // T_new_old
    double quat[4];                    // w, x, y, z of the rotation
    int stride, count;
};
